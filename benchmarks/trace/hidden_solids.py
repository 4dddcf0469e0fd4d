"""Bodies for ``benchmarks.trace.hidden_effects --set hidden_solids``, which Kratos records only where it has converged.

Lumps in a small grip, thick bars, slabs that hang by two corners. Each is recorded on fine cells, and again on coarse
ones with twice the step. Coarse cells are too stiff, and a stiffness is what every fit finds by itself: where the two
differ by more than a third of the camera's noise beyond what another stiffness does, the recording is refused.

``python -m benchmarks.trace.hidden_solids BODY SEED`` says what the step alone changes and what the cells change.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.peers.finite_elements import Acting, Floats, Place
from benchmarks.trace.hidden_bodies import FILLING, POISSON, TRACKED, Hand, Motion, Object, Recorder
from physworld.geometry.sheet_body import SHEET_KINDS

if TYPE_CHECKING:
    from benchmarks.peers.kratos_solids import Solid

ALLOWED_M = 1e-3 / 3.0  # a third of the noise, root mean square per axis on the frames where it is largest
_STIFFER = 0.02  # for what a stiffness changes, to first order
Lines = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]


class NotConvergedError(ValueError):
    """Finer cells and half the step change a recording by more than a third of its noise, beside its stiffness."""


@dataclass(frozen=True)
class Converged(Object):
    """A body that is recorded twice.

    Attributes:
        fine, coarse: where cells begin and end along the axes of the unit cube.
        step_s: of the coarse cells, stable for the fine ones too; these have half of it.
        frames: of a recording.
    """

    fine: Lines = ((), (), ())
    coarse: Lines = ((), (), ())
    step_s: float = 0.0
    frames: int = 45

    def recorder(self, seed: int, rng: np.random.Generator) -> Recorder:
        """Quadratic hexahedra; a camera sees places of the surface, of a sheet any."""
        from benchmarks.peers.kratos_solids import Solid

        unit = rng.uniform(0.0, 1.0, (TRACKED, 3))
        if self.kind not in SHEET_KINDS:
            unit[np.arange(TRACKED), rng.integers(1, 3, TRACKED)] = rng.integers(0, 2, TRACKED)
        meshes = [
            Solid(lines, self.shape, young_pa, POISSON, self.density_kg_m3)
            for lines, young_pa in (
                (self.fine, self.young_pa),
                (self.coarse, self.young_pa),
                (self.coarse, (1.0 + _STIFFER) * self.young_pa),
            )
        ]
        boxes = [self._box(np.array(box)) for box in self.held]
        motions = [Motion(10 * seed + g, self.stroke_m, self.turn_rad) for g in range(len(boxes))]
        centres = [_held(meshes[0], box)[1] for box in boxes]

        def seen(mesh: Solid, step_s: float, acting: Acting, late_s: float, at: Floats) -> Floats:
            grips: list[tuple[Any, Place]] = [
                (_held(mesh, box)[0], partial(_about, _held(mesh, box)[1], centre, motion, late_s))
                for box, centre, motion in zip(boxes, centres, motions, strict=True)
            ]
            nodes, weights = mesh.weights(unit)
            found: Floats = np.einsum(
                "pk,tpki->tpi", weights, mesh.record(acting, grips, at, step_s)[:, nodes]
            )
            return found

        rough = partial(seen, meshes[1], self.step_s)

        def tracks(acting: Acting, late_s: float, at: Floats) -> Floats:
            found = seen(meshes[0], 0.5 * self.step_s, acting, late_s, at)
            coarse, stiffer = (seen(mesh, self.step_s, acting, late_s, at) for mesh in meshes[1:])
            share, left = without_stiffness(found - coarse, (stiffer - coarse) / _STIFFER)
            change = largest_change_m(left, np.zeros_like(left))
            print(
                f"{self.kind}, seed {seed}: coarser cells change it as {share:+.1%} of stiffness, but for "
                f"{1e3 * change:.3f} mm",
                flush=True,
            )
            if change > ALLOWED_M:
                raise NotConvergedError(
                    f"coarser cells and twice the step change it by {1e3 * change:.2f} mm beside its stiffness, more "
                    f"than {1e3 * ALLOWED_M:.2f} mm"
                )
            return found

        hands = [
            Hand(box, centre, motion) for box, centre, motion in zip(boxes, centres, motions, strict=True)
        ]
        return Recorder(hands, tracks, lambda r: self.shape(r.uniform(0.0, 1.0, (FILLING, 3))), rough)


def largest_change_m(one: Floats, other: Floats) -> float:
    """Root mean square per axis over the points (T, N, 3) [m] of the frame where two recordings differ most."""
    return float(np.sqrt(np.mean((one - other) ** 2, axis=(1, 2))).max())


def _held(mesh: Solid, box: Floats) -> tuple[np.ndarray, Floats]:
    nodes = np.flatnonzero(np.all((mesh.nodes >= box[0] - 1e-9) & (mesh.nodes <= box[1] + 1e-9), axis=1))
    return nodes, mesh.nodes[nodes].mean(axis=0)


def _about(mean: Floats, centre: Floats, motion: Motion, late_s: float, time: float) -> tuple[Floats, Floats]:
    """A mesh turns its grip about the mean of its own nodes, a hand about one centre on all meshes."""
    turn, shift = motion.place(late_s, time)
    return turn, shift + (turn - np.eye(3)) @ (mean - centre)


def _even(count: int, start: float = 0.0, end: float = 1.0) -> tuple[float, ...]:
    return tuple(np.linspace(start, end, count + 1).tolist())


_THIRDS = (0.0, 1 / 3, 1 / 2, 2 / 3, 1.0)
_FIFTHS = (0.0, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
SOLIDS: dict[str, Converged] = {
    "gripped lump": Converged(
        "blob", (0.2, 0.1, 0.09), (8, 4, 4), 1.6e5, 540.0, (((0.0, 1 / 3, 1 / 3), (1 / 6, 2 / 3, 2 / 3)),), 0.015,
        round=True, around=True, fine=((*_even(2, 0.0, 1 / 6)[:-1], *_even(6, 1 / 6)), _THIRDS, _THIRDS),
        coarse=(_even(6), _even(3), _even(3)), step_s=1.6e-4,
    ),
    "thick bar": Converged(
        "beam", (0.26, 0.05, 0.05), (8, 3, 3), 4e5, 600.0, (((0.0, 0.0, 0.0), (1 / 12, 1.0, 1.0)),), 0.02, 0.15,
        fine=((0.0, *_even(7, 1 / 12)), _even(3), _even(3)), coarse=((0.0, *_even(5, 1 / 12)), _even(2), _even(2)),
        step_s=1.4e-4,
    ),
    "corner slab": Converged(
        "sheet", (0.22, 0.02, 0.2), (8, 1, 8), 2.6e5, 350.0,
        (((0.0, 0.0, 0.8), (0.2, 1.0, 1.0)), ((0.8, 0.0, 0.8), (1.0, 1.0, 1.0))), (0.004, 0.03, 0.02),
        fine=(_FIFTHS, (0.0, 1.0), _FIFTHS), coarse=(_even(5), (0.0, 1.0), _even(5)), step_s=1.3e-4,
    ),
}  # fmt: skip


def main() -> int:
    """Print what step and cells change in one recording without an effect."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.hidden_solids", description=__doc__)
    parser.add_argument("body", choices=sorted(SOLIDS))
    parser.add_argument("seed", type=int)
    given = parser.parse_args()
    body = SOLIDS[given.body]
    times = np.arange(body.frames) / 30.0

    def recorded(other: Converged) -> Floats:
        rough = other.recorder(given.seed, np.random.default_rng(900 + given.seed)).rough
        assert rough is not None
        return rough(Acting(), 0.0, times)

    coarse = recorded(body)
    step = recorded(replace(body, step_s=0.5 * body.step_s))
    print(f"half the step changes coarse cells by {1e3 * largest_change_m(step, coarse):.3f} mm", flush=True)
    fine = recorded(replace(body, coarse=body.fine, step_s=0.5 * body.step_s))
    print(f"fine cells change it by {1e3 * largest_change_m(fine, step):.3f} mm", flush=True)
    stiffer = recorded(replace(body, young_pa=(1.0 + _STIFFER) * body.young_pa))
    share, left = without_stiffness(fine - step, (stiffer - coarse) / _STIFFER)
    print(f"as {share:+.1%} of stiffness, but for {1e3 * largest_change_m(left, np.zeros_like(left)):.3f} mm")
    return 0


def without_stiffness(change: Floats, by_stiffness: Floats) -> tuple[float, Floats]:
    """The share of stiffness that is nearest to a change (T, N, 3) [m], to first order, and what it leaves of it."""
    share = float(np.sum(change * by_stiffness) / np.sum(by_stiffness**2))
    return share, change - share * by_stiffness


if __name__ == "__main__":
    sys.exit(main())
