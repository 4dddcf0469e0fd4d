"""A sheet as a mesh of triangles beside MuJoCo flex, which computes it as such: forces and motion of the same mesh."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import warp as wp

from benchmarks.peers.flex_sheet import FlexSheet, record
from physworld.devices import default_device
from physworld.engine.thin.triangles import Mesh, triangle_lattice
from physworld.engine.total.forces import InternalForces
from physworld.materials.sheet import SheetLaw
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SHEET = FlexSheet(frames=16, noise_sigma_m=0.0, seed=1)


def law_of(sheet: FlexSheet) -> SheetLaw:
    membrane = sheet.young_pa * sheet.thickness_m / (1.0 - sheet.poisson**2)
    return SheetLaw(
        membrane, membrane * sheet.thickness_m**2 / 12.0, sheet.poisson,
        density_kg_m2=sheet.density_kg_m3 * sheet.thickness_m,
    )  # fmt: skip


@pytest.mark.parametrize(("cells", "odd"), [((5, 4), False), ((5, 4), True)])
def test_forces_of_a_crumpled_mesh_are_mujocos(cells: tuple[int, int], odd: bool) -> None:
    class Sheet(FlexSheet):
        def triangles(self) -> np.ndarray:
            return triangle_lattice(np.array(self.size_m), Mesh(self.counts, odd)).triangles.astype(np.int64)

    sheet = Sheet(cells=cells)
    model, rest = sheet.model(), sheet.vertices()
    pushed = np.random.default_rng(0).normal(0.0, 3e-3, rest.shape)
    data = mujoco.MjData(model)
    data.qpos[:] = pushed.ravel()
    mujoco.mj_forward(model, data)
    lattice = triangle_lattice(np.array(sheet.size_m), Mesh(cells, odd))
    forces = InternalForces(lattice, law_of(sheet), np.ones(lattice.fill.size), rest, default_device())
    found = wp.zeros(rest.size, dtype=wp.float64)
    forces.launch(wp.array((rest + pushed).ravel(), dtype=wp.float64), wp.zeros(3, dtype=wp.float64), found)
    assert found.numpy() == pytest.approx(data.qfrc_spring, abs=1e-7 * np.abs(data.qfrc_spring).max())


def test_a_mesh_moves_like_mujocos_and_no_other_mesh_does() -> None:
    scene = record(SHEET)

    def missed(mesh: Mesh | None) -> float:
        twin: Twin = build_twin(scene, mesh=mesh)
        law = law_of(SHEET)
        nodes = twin.with_parameters(
            membrane_n_m=law.membrane_n_m, bending_n_m=law.bending_n_m, poissons_ratio=law.poissons_ratio
        ).simulate_nodes(*scene.control_track(), scene.times)
        return float(np.sqrt(np.mean((twin.observe(nodes, scene.times) - scene.points)[-5:] ** 2)))

    moved = float(np.sqrt(np.mean((scene.points - scene.points[0])[-5:] ** 2)))
    own = missed(Mesh((16, 15)))
    assert own < 0.02 * moved
    assert own < 0.5 * min(missed(Mesh((16, 15), odd=True)), missed(Mesh((24, 22))), missed(None))
