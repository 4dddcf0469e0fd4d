"""What the formulations and transfers lose: free vibration of two cantilevers without any damping in the physics.

A beam is let go from level under gravity and rings about its droop. The rate is that of the linear drag (a = -c v)
that would take as much amplitude, from the ranges of the tip in the first and the last part of the run; the damping
ratio is c / 2 omega. The first beam is like `shared/data/real/beam_free_a` (its measured damping ratio is about 0.05),
the second the 0.3 m beam of the design notes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from benchmarks.harness import Report, run_alone
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.engine.updated.formulation import UpdatedLagrangian
from physworld.engine.updated.transfer import Apic, Asflip
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.solid import SolidLaw

GRAVITY = np.array([0.0, 0.0, -9.81])
FRAME_S = 0.005
PARTS = 3  # the first and the last of so many equal parts are compared


@dataclass(frozen=True)
class Beam:
    """A square cantilever: free length, side [m], cells along and across, law, time simulated [s]."""

    length_m: float
    side_m: float
    cells: tuple[int, int]
    law: SolidLaw
    seconds: float

    @property
    def lattice(self) -> Lattice:
        """The free length and one gripped cell before it."""
        dx = self.length_m / self.cells[0]
        return box_lattice(
            np.array([-dx, 0.0, 0.0]),
            np.array([self.length_m + dx, self.side_m, self.side_m]),
            (self.cells[0] + 1, self.cells[1], self.cells[1]),
        )


SILICONE = NeoHookean(264e3, 0.35, density_kg_m3=1070.0)
FOAM = NeoHookean(9e5, 0.3, density_kg_m3=600.0)
BEAMS = {
    "silicone, 0.1 m, 10 mm": Beam(0.1, 0.03, (10, 3), SILICONE, 2.0),
    "silicone, 0.1 m, 5 mm": Beam(0.1, 0.03, (20, 6), SILICONE, 1.2),
    "0.3 m, 14 mm": Beam(0.3, 0.042, (21, 3), FOAM, 3.0),
}
SCHEMES = {
    "total Lagrangian": lambda problem: TotalLagrangian(problem),
    "APIC": lambda problem: UpdatedLagrangian(problem, transfer=Apic()),
    "ASFLIP (ours: all kept, no moves)": lambda problem: UpdatedLagrangian(problem, transfer=Asflip()),
    "ASFLIP 0.99, no moves": lambda problem: UpdatedLagrangian(problem, transfer=Asflip(0.99)),
    "ASFLIP 0.99 (the paper's)": lambda problem: UpdatedLagrangian(problem, transfer=Asflip(0.99, 0.999)),
}


def measure(repeats: int, seed: int) -> Report:
    """Every scheme on every beam; deterministic, so that repeats and seed change nothing."""
    wp.config.quiet = True
    figures: dict[str, dict[str, dict[str, float]]] = {}
    rows = []
    for name, beam in BEAMS.items():
        figures[name] = {}
        for scheme, make in SCHEMES.items():
            found = ringing(beam, make)
            figures[name][scheme] = found
            droop = found["mean_droop_m"] / figures[name]["total Lagrangian"]["mean_droop_m"]
            rows.append(
                [
                    name,
                    scheme,
                    f"{found['drag_per_s']:.3f}",
                    f"{found['damping_ratio']:.4f}",
                    f"{found['frequency_hz']:.2f}",
                    f"{droop:.3f}",
                ]
            )
    return Report(
        name="transfers",
        title="Numerical damping of a freely ringing cantilever",
        figures=figures,
        header=[
            "beam, cell",
            "scheme",
            "as drag, 1/s",
            "damping ratio",
            "Hz",
            "mean droop / total Lagrangian",
        ],
        rows=rows,
        notes=[
            "No damping in the physics: all of it is the scheme's.",
            "As drag: the linear drag that would lose as much amplitude. A negative rate is a growing amplitude.",
            "Mean droop: of the tip over the last third; a beam that rings in the updated Lagrangian form also creeps.",
        ],
        seed=seed,
    )


def ringing(beam: Beam, make: Callable[[Problem], TotalLagrangian | UpdatedLagrangian]) -> dict[str, float]:
    """Rate of loss, frequency and droop of the tip."""
    lattice = beam.lattice
    rest, times = lattice.node_coordinates, np.arange(0.0, beam.seconds, FRAME_S)
    gripped = np.unique(lattice.cell_nodes[lattice.cells[:, 0] == 0])
    paths = np.repeat(rest[gripped][None], len(times), axis=0)
    engine = make(Problem(lattice, beam.law, rest, GRAVITY))
    nodes = engine.run(rest, np.zeros_like(rest), HeldNodes(gripped, paths, np.zeros_like(paths)), times)
    row = lattice.interpolation(np.array([[beam.length_m, beam.side_m / 2, beam.side_m / 2]]))
    tip = np.array([(row @ frame)[0, 2] for frame in nodes]) - beam.side_m / 2
    part = len(tip) // PARTS
    first, last = tip[:part], tip[-part:]
    rate = -2.0 * np.log(np.ptp(last) / np.ptp(first)) / (times[-part] - times[0])
    spectrum = np.abs(np.fft.rfft(tip - tip.mean(), 16 * len(tip)))
    frequency = float(np.argmax(spectrum)) / (16 * len(tip) * FRAME_S)
    return {
        "drag_per_s": float(rate),
        "damping_ratio": float(rate / (4.0 * np.pi * frequency)),
        "frequency_hz": frequency,
        "mean_droop_m": float(-last.mean()),
    }


if __name__ == "__main__":
    run_alone(measure)
