"""MPM forward simulation: ns per particle and substep, ours beside a plain Taichi MLS-MPM, one thread.

The same block (E 1e5 Pa, ν 0.35, ρ 1000 kg/m³, neo-Hookean), the same particles, the same grid spacing, the
same time step and the same first motion (stretching along x, no gravity) in all. Ours is the engine that the
twin uses for elastic bodies: total Lagrangian, nodes in float64, the grid bound to the reference body; beside it
ours for flowing ones: updated Lagrangian MLS-MPM with APIC, like the peer. The peer is the usual MLS-MPM with
quadratic B-splines and APIC in float32, as Taichi's own examples write it, on two grids: 64³ nodes, as is
usual, and just large enough for the motion. The limit is the same MLS-MPM written by hand in C++ for this processor,
on the tight grid.

The forms discretise differently, so the table also shows what they agree on: the block's largest length.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
import taichi as ti
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from benchmarks.peers.mpm_limit import library, mls_mpm
from benchmarks.speed.gradients import cost
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SIZE_M = np.array([0.25, 0.125, 0.125])
MODULUS_PA, POISSON, DENSITY_KG_M3 = 1e5, 0.35, 1000.0
STRAIN_RATE_PER_S = 4.0
USUAL_GRID = 64
BUDGETS = {"2k": 2000, "10k": 10_000}
SUBSTEPS = {"2k": 1600, "10k": 400}
TIMED_RECORDS = 10
CHECKED_SUBSTEPS, CHECKED_RECORDS = 160, 20  # more than half a period of the stretching
TAICHI_MARGIN_CELLS = 6
COLUMNS = ("ours", "ours_updated", "taichi_grid64", "taichi_tight", "limit")

Engine = Callable[[int, int], tuple[float, np.ndarray]]
"""(substeps, records) to seconds a substep and the length along x at every record [m]."""


@dataclass(frozen=True)
class Block:
    """The common task.

    Attributes:
        twin: ours.
        particles: positions [m], (P, 3).
        volumes: of the particles [m³], (P,).
        spacing_m: grid spacing.
        dt_s: time step.
        substeps: how many are timed.
    """

    twin: Twin
    particles: np.ndarray
    volumes: np.ndarray
    spacing_m: float
    dt_s: float
    substeps: int


def measure(repeats: int, seed: int) -> Report:
    """Both engines at about 2k and 10k particles. Nothing in it is random."""
    wp.config.quiet = True
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f32, log_level=ti.ERROR, offline_cache=True)
    figures: dict[str, object] = {}
    rows = []
    compiled = library()
    medians: dict[str, dict[str, float]] = {"ours": {}, "ours_updated": {}, "taichi": {}, "limit": {}}
    for size, budget in BUDGETS.items():
        block = make_block(budget, SUBSTEPS[size])
        engines = {
            "ours": ours(block),
            "ours_updated": ours_updated(block),
            "taichi_grid64": taichi_mls_mpm(block, USUAL_GRID),
            "taichi_tight": taichi_mls_mpm(block, _tight_grid(block)),
        }
        if compiled is not None:
            engines["limit"] = limit(compiled, block)
        # also compiles, captures and warms the caches
        lengths = {}
        for name, run in engines.items():
            lengths[name] = float(run(CHECKED_SUBSTEPS, CHECKED_RECORDS)[1].max())
        timings = interleave({name: _nanoseconds(run, block) for name, run in engines.items()}, repeats)
        count = len(block.particles)
        ratios = {name: timings[name].median / timings["ours"].median for name in timings if name != "ours"}
        figures[size] = {
            "particles": count,
            "substeps": block.substeps,
            "dt_s": block.dt_s,
            "ns_per_particle_substep": {name: timing.median for name, timing in timings.items()},
            "spread": {name: timing.spread for name, timing in timings.items()},
            "ratio_to_ours": ratios,
            "peak_length_m": lengths,
        }
        for name, key in (("ours",) * 2, ("ours_updated",) * 2, ("taichi", "taichi_tight"), ("limit",) * 2):
            if key in timings:
                medians[name][size] = timings[key].median
        rows.append(
            [
                f"{count}",
                *(
                    f"{timings[n].median:.0f} ± {timings[n].spread:.0f}" if n in timings else "-"
                    for n in COLUMNS
                ),
                " / ".join(f"{ratio:.1f}" for ratio in ratios.values()),
                " / ".join(f"{1e3 * lengths[name]:.1f}" for name in engines),
            ]
        )
    gradient = cost(repeats)
    figures |= {key: gradient[key] for key in ("gradient_in_forwards", "gradient_memory_mb")}
    figures["ns_per_particle_substep"] = medians
    figures["two_worker_speedup"] = speedup = two_worker_speedup(repeats)
    return Report(
        name="mpm",
        title="MPM forward, ns per particle-substep, one thread",
        figures=figures,
        header=[
            "particles",
            "ours, total",
            "ours, updated",
            "Taichi, 64³ grid",
            "Taichi, tight grid",
            "C++ by hand",
            "ratio to total",
            "peak length, mm",
        ],
        rows=rows,
        notes=[
            "Lower is better; ± is half the distance between the quartiles of the rounds.",
            "Peak length: largest extent of the particles along x in the first stretch, in the order of the "
            "engines: they simulate the same thing.",
            "Ours, total: total Lagrangian (fixed weights, no transfer), nodes in float64, strains in float32. Ours, "
            "updated: MLS-MPM with APIC as Taichi's, positions and deformation gradients in float64, the rest in "
            "float32, the grid on the body's box. Taichi and C++ by hand (`benchmarks/mpm_limit.cpp`): "
            "MLS-MPM (APIC), float32.",
            f"Two processes against one, total Lagrangian, 2000 particles: {speedup:.2f} times the substeps a second.",
            f"One gradient through 100 frames of 2000 particles (total Lagrangian) takes "
            f"{gradient['gradient_in_forwards']:.1f} forward runs and keeps {gradient['gradient_memory_mb']:.0f} MB; "
            "see docs/gradients.md.",
        ],
        seed=seed,
    )


def make_block(budget: int, substeps: int) -> Block:
    """The block with about ``budget`` particles, at the time step that our engine calls stable."""
    still = np.zeros((2, 1, 3))
    scene = Scene(
        name="block",
        kind="block",
        points=still + SIZE_M / 2,
        visible=np.ones((2, 1), dtype=bool),
        controllers=np.zeros((2, 0, 3)),
        times=np.array([0.0, 1.0 / 30.0]),
        gravity_m_s2=np.zeros(3),
        noise_sigma_m=None,
        train=(0, 1),
        test=(1, 2),
        initial_state=UNDEFORMED_AT_REST,
        body=Body(size_m=SIZE_M, box_min_m=np.zeros(3), box_max_m=SIZE_M, density_kg_m3=DENSITY_KG_M3),
    )
    twin = build_twin(scene, budget).with_parameters(youngs_modulus_pa=MODULUS_PA, poissons_ratio=POISSON)
    return Block(
        twin=twin,
        particles=np.asarray(twin.particles_start),
        volumes=twin.lattice.particle_measures,
        spacing_m=float(twin.lattice.spacing.mean()),
        dt_s=TotalLagrangian(_problem(twin)).time_step_s,
        substeps=substeps,
    )


def ours(block: Block) -> Engine:
    """Our engine on the block."""
    twin = block.twin
    nodes = twin.body.start
    velocity = np.zeros_like(nodes)
    velocity[:, 0] = STRAIN_RATE_PER_S * (nodes[:, 0] - SIZE_M[0] / 2)
    engine = TotalLagrangian(_problem(twin))

    def run(substeps: int, records: int) -> tuple[float, np.ndarray]:
        times = np.linspace(0.0, substeps * block.dt_s, records + 1)
        held = HeldNodes(np.empty(0, dtype=int), *np.zeros((2, records + 1, 0, 3)))
        engine.substeps = 0
        start = time.perf_counter()
        path = engine.run(nodes, velocity, held, times)
        seconds = time.perf_counter() - start
        return seconds / engine.substeps, np.ptp(twin.particles_at(path)[..., 0], axis=1)

    return run


def ours_updated(block: Block) -> Engine:
    """Our engine for flowing bodies on the block, elastic here, at the same time step."""
    twin = block.twin
    nodes = twin.body.start
    velocity = np.zeros_like(nodes)
    velocity[:, 0] = STRAIN_RATE_PER_S * (nodes[:, 0] - SIZE_M[0] / 2)
    engine = UpdatedLagrangian(_problem(twin), time_step_s=block.dt_s)

    def run(substeps: int, records: int) -> tuple[float, np.ndarray]:
        times = np.linspace(0.0, substeps * block.dt_s, records + 1)
        held = HeldNodes(np.empty(0, dtype=int), *np.zeros((2, records + 1, 0, 3)))
        engine.substeps = 0
        start = time.perf_counter()
        particles = engine.run_particles(nodes, velocity, held, times)
        seconds = time.perf_counter() - start
        return seconds / engine.substeps, np.ptp(particles[..., 0], axis=1)

    return run


def limit(compiled: ctypes.CDLL, block: Block) -> Engine:
    """The step written by hand, on the tight grid."""
    mu = MODULUS_PA / (2 * (1 + POISSON))
    lam = MODULUS_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    centred, material = block.particles - SIZE_M / 2, (mu, lam, DENSITY_KG_M3)
    grid = _tight_grid(block)
    return mls_mpm(
        compiled, centred, block.volumes, STRAIN_RATE_PER_S, grid, block.spacing_m, block.dt_s, material
    )


def two_worker_speedup(repeats: int) -> float:
    """Substeps a second of two processes that simulate the small block side by side, over one's."""
    ratios = []
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(_seconds_a_substep, range(2)))  # compiles and warms the caches
        for _ in range(repeats):
            alone = pool.submit(_seconds_a_substep, 0).result()
            together = list(pool.map(_seconds_a_substep, range(2)))
            ratios.append(alone * sum(1.0 / seconds for seconds in together))
    return float(np.median(ratios))


def _seconds_a_substep(number: int) -> float:
    del number
    wp.config.quiet = True
    block = make_block(BUDGETS["2k"], SUBSTEPS["2k"])
    engine = ours(block)
    engine(SUBSTEPS["10k"], 1)
    return engine(10 * SUBSTEPS["2k"], TIMED_RECORDS)[0]


def taichi_mls_mpm(block: Block, grid: int) -> Engine:
    """A plain MLS-MPM on a dense ``grid``³ of the block's spacing."""
    count, dx, dt = len(block.particles), block.spacing_m, block.dt_s
    inv_dx = 1.0 / dx
    mu = MODULUS_PA / (2 * (1 + POISSON))
    lam = MODULUS_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    density = DENSITY_KG_M3
    x, v = ti.Vector.field(3, float, count), ti.Vector.field(3, float, count)
    C, F = ti.Matrix.field(3, 3, float, count), ti.Matrix.field(3, 3, float, count)
    volume = ti.field(float, count)
    grid_v, grid_m = ti.Vector.field(3, float, (grid,) * 3), ti.field(float, (grid,) * 3)

    @ti.kernel
    def substep():
        for node in ti.grouped(grid_m):
            grid_v[node] = ti.Vector.zero(float, 3)
            grid_m[node] = 0.0
        for p in x:
            base = ti.cast(x[p] * inv_dx - 0.5, int)
            fx = x[p] * inv_dx - ti.cast(base, float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            identity = ti.Matrix.identity(float, 3)
            F[p] = (identity + dt * C[p]) @ F[p]
            # Kirchhoff stress of W = mu/2 (tr FᵀF - 3 - 2 ln J) + lambda/2 (ln J)²
            stress = mu * (F[p] @ F[p].transpose() - identity) + lam * ti.log(F[p].determinant()) * identity
            mass = density * volume[p]
            affine = -dt * 4.0 * inv_dx * inv_dx * volume[p] * stress + mass * C[p]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                weight = w[i][0] * w[j][1] * w[k][2]
                dpos = (ti.cast(offset, float) - fx) * dx
                grid_v[base + offset] += weight * (mass * v[p] + affine @ dpos)
                grid_m[base + offset] += weight * mass
        for node in ti.grouped(grid_m):
            if grid_m[node] > 0.0:
                grid_v[node] /= grid_m[node]
        for p in x:
            base = ti.cast(x[p] * inv_dx - 0.5, int)
            fx = x[p] * inv_dx - ti.cast(base, float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            new_v = ti.Vector.zero(float, 3)
            new_C = ti.Matrix.zero(float, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                weight = w[i][0] * w[j][1] * w[k][2]
                dpos = ti.cast(offset, float) - fx
                node_v = grid_v[base + offset]
                new_v += weight * node_v
                new_C += 4.0 * inv_dx * weight * node_v.outer_product(dpos)
            v[p], C[p] = new_v, new_C
            x[p] += dt * new_v

    first = block.particles - SIZE_M / 2 + 0.5 * grid * dx
    speed = np.zeros_like(first)
    speed[:, 0] = STRAIN_RATE_PER_S * (block.particles[:, 0] - SIZE_M[0] / 2)
    gradient = np.zeros((count, 3, 3))
    gradient[:, 0, 0] = STRAIN_RATE_PER_S

    def run(substeps: int, records: int) -> tuple[float, np.ndarray]:
        x.from_numpy(first.astype(np.float32))
        v.from_numpy(speed.astype(np.float32))
        C.from_numpy(gradient.astype(np.float32))
        F.from_numpy(np.repeat(np.eye(3, dtype=np.float32)[None], count, axis=0))
        volume.from_numpy(block.volumes.astype(np.float32))
        lengths, seconds = [], 0.0
        for _ in range(records):
            start = time.perf_counter()
            for _ in range(substeps // records):
                substep()
            ti.sync()
            seconds += time.perf_counter() - start
            lengths.append(float(np.ptp(x.to_numpy()[:, 0])))
        return seconds / (records * (substeps // records)), np.array(lengths)

    return run


def _nanoseconds(run: Engine, block: Block) -> Callable[[], float]:
    """The case: ns per particle-substep of a run."""
    return lambda: 1e9 * run(block.substeps, TIMED_RECORDS)[0] / len(block.particles)


def _problem(twin: Twin) -> Problem:
    return Problem(twin.lattice, twin.law, twin.body.rest, twin.gravity_m_s2)


def _tight_grid(block: Block) -> int:
    """Nodes per axis that the block's longest side needs, with room to stretch."""
    return int(np.ceil(1.3 * SIZE_M[0] / block.spacing_m)) + TAICHI_MARGIN_CELLS


if __name__ == "__main__":
    run_alone(measure)
