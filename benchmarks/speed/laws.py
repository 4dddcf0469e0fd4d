"""What a constitutive law costs: ns per particle and substep, and per particle of one product with the tangent.

The block of ``benchmarks.speed.mpm`` (11,016 particles) under every law of solids with the same moduli, one thread; a
sheet and a rod of about as many particles. A substep is all of it: forces, grips, the nodes' step. A tangent is one
call of ``InternalTangent``: d(w.f)/dx, with friction also d(w.f)/dx_previous, and the derivative by every modulus of
every particle. The thread's own processor time is taken, so that other processes on the machine disturb little.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks.harness import Report, interleave, run_alone
from benchmarks.speed.mpm import BUDGETS, MODULUS_PA, POISSON, make_block
from benchmarks.verification.cases import rest_nodes
from physworld.engine.gradients.tangent import InternalTangent
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.laws import Law
from physworld.materials.library import SOLID_LAWS
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw

SUBSTEPS, PRODUCTS = 80, 8
DT_SHARE = 0.5  # of the engine's own time step: the cost does not depend on it
STRETCHING_PER_S = 0.5

_SOLIDS = {name: (3, law(MODULUS_PA, POISSON)) for name, law in SOLID_LAWS.items()}
_VISCOUS = {"neo_hookean, friction": (3, SOLID_LAWS["neo_hookean"](MODULUS_PA, POISSON, viscosity_pa_s=1.0))}
_THIN: dict[str, tuple[int, Law]] = {
    "isotropic_sheet": (2, SheetLaw(200.0, 1e-4)),
    "isotropic_sheet, friction": (2, SheetLaw(200.0, 1e-4, relaxation_s=1e-4)),
    "orthotropic_sheet": (2, OrthotropicSheetLaw(200.0, 1e-4, shear_ratio=0.1)),
    "rod": (1, RodLaw(100.0, 1e-3)),
    "rod, friction": (1, RodLaw(100.0, 1e-3, relaxation_s=1e-4)),
}


def measure(repeats: int, seed: int) -> Report:
    """Every law in turn. The direction of the tangent is random."""
    wp.config.quiet = True
    lattices = {
        3: make_block(BUDGETS["10k"], SUBSTEPS).twin.lattice,
        2: box_lattice(np.zeros(2), np.array([0.5, 0.5]), (52, 52)),
        1: box_lattice(np.zeros(1), np.array([5.0]), (5400,)),
    }
    substeps, products = {}, {}
    for name, (dimension, law) in {**_SOLIDS, **_VISCOUS, **_THIN}.items():
        substeps[name] = _substep(lattices[dimension], law)
        products[name] = _product(lattices[dimension], law, np.random.default_rng(seed))
        substeps[name](), products[name]()  # compiles
    forward, tangent = interleave(substeps, repeats), interleave(products, repeats)
    figures = {
        name: {"substep_ns": forward[name].median, "tangent_ns": tangent[name].median} for name in substeps
    }
    base = forward["neo_hookean"].median
    rows = [
        [
            name,
            f"{forward[name].median:.0f} ± {forward[name].spread:.0f}",
            f"{forward[name].median / base:.2f}",
            f"{tangent[name].median:.0f} ± {tangent[name].spread:.0f}",
            f"{tangent[name].median / forward[name].median:.1f}",
        ]
        for name in substeps
    ]
    return Report(
        name="laws",
        title="Constitutive laws, ns per particle, one thread",
        figures=figures,
        header=["law", "substep", "over neo-Hookean", "tangent", "tangent over substep"],
        rows=rows,
        notes=[
            "Lower is better; processor time; ± is half the distance between the quartiles of the rounds."
        ],
        seed=seed,
    )


def _substep(lattice: Lattice, law: Law) -> Callable[[], float]:
    rest = rest_nodes(lattice)
    engine = TotalLagrangian(Problem(lattice, law, rest, np.zeros(3)))
    velocity = np.zeros_like(rest)
    velocity[:, 0] = STRETCHING_PER_S * (rest[:, 0] - rest[:, 0].mean())
    held = HeldNodes(np.empty(0, dtype=int), *np.zeros((2, 2, 0, 3)))
    times = np.array([0.0, SUBSTEPS * DT_SHARE * engine.time_step_s])

    def run() -> float:
        engine.substeps = 0
        start = time.thread_time()
        engine.run(rest, velocity, held, times)
        return 1e9 * (time.thread_time() - start) / engine.substeps / lattice.fill.size

    return run


def _product(lattice: Lattice, law: Law, random: np.random.Generator) -> Callable[[], float]:
    rest = rest_nodes(lattice)
    tangent = InternalTangent(lattice, law, np.ones(lattice.fill.size), rest, "cpu")

    def upload(values: np.ndarray) -> wp.array:
        return wp.array(values.reshape(-1), dtype=wp.float64)

    x, w = upload(rest * [1.1, 1.0, 1.0]), upload(random.normal(size=rest.shape))
    out, late = wp.zeros(rest.size, dtype=wp.float64), wp.zeros(rest.size, dtype=wp.float64)
    parameters = wp.zeros(tangent.particles * len(tangent.parameters), dtype=wp.float64)
    clock = wp.array([0.0, 1e4, 1e-4], dtype=wp.float64)

    def run() -> float:
        start = time.thread_time()
        for _ in range(PRODUCTS):
            tangent.apply_with_friction(x, x, clock, w, out, late, parameters)
        return 1e9 * (time.thread_time() - start) / PRODUCTS / lattice.fill.size

    return run


if __name__ == "__main__":
    run_alone(measure)
