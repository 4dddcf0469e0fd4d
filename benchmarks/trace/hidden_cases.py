"""What is recorded for ``benchmarks.trace.hidden_effects``: bodies, what acts on each, and which verdicts are right."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.trace.folder import CLAIMS
from benchmarks.trace.hidden_bodies import TOP_M


@dataclass(frozen=True)
class Case:
    """One recording: ``acts`` in the terms of the truth's file, ``answers`` the verdicts that are right."""

    name: str
    object: str
    seed: int
    acts: dict[str, dict[str, Any]] = field(default_factory=dict)
    answers: tuple[str, ...] = CLAIMS


def cases() -> tuple[Case, ...]:
    """Every recording; strengths are drawn by the number of the case."""

    def drawn(number: int, low: float, high: float) -> float:
        return float(np.random.default_rng(7000 + number).uniform(low, high))

    nothing = ("nothing_to_explain",)
    tether = {"k": 6.0, "anchor": [0.05, -0.25, 0.4], "attach": [0.11, 0.0, TOP_M], "radius": 0.025,
              "rest_length": 0.25}  # fmt: skip
    line = {"k": 0.8, "anchor": [0.35, 0.2, 0.1], "attach": [0.21, 0.0, TOP_M - 0.36], "radius": 0.02,
            "rest_length": 0.12}  # fmt: skip
    return (
        Case("e01", "beam", 1, answers=nothing),
        Case("e02", "beam", 2, {"quadratic_drag": {"k": drawn(2, 0.8, 2.5)}}),
        Case("e03", "beam", 3, {"control_lag": {"seconds": drawn(3, 0.02, 0.05)}}),
        Case("e04", "beam", 4, {"tether": tether}),
        Case("e05", "beam", 5, {"linear_drag": {"c": drawn(5, 1.0, 2.5)},
             "gravity_tilt": {"degrees": drawn(50, 2.5, 5.0), "axis": [1.0, 0.4, 0.0]}}),
        Case("e06", "beam", 6, {"gust": {"m_s2": 12.0, "from_s": 0.7, "to_s": 0.8}}, ("unexplained",)),
        Case("e07", "beam", 7, {"clock": {"offset_s": drawn(7, 0.02, 0.04)}}, ("data_issue", *CLAIMS)),
        Case("e08", "blob", 8, {"gravity_tilt": {"degrees": drawn(8, 3.0, 6.0), "axis": [0.3, 1.0, 0.0]}}),
        Case("e09", "blob", 9, {"internal_viscosity": {"eta": drawn(9, 20.0, 40.0)}}),
        Case("e10", "blob", 10, answers=nothing),
        Case("e11", "slab", 11, {"fibre": {"modulus": drawn(11, 4e5, 7e5), "axis": [1.0, 0.0, 0.6]}}),
        Case("e12", "slab", 12, {"linear_drag": {"c": drawn(12, 1.5, 3.0)}}),
        Case("e13", "rope", 13, answers=nothing),
        Case("e14", "rope", 14, {"linear_drag": {"c": drawn(14, 1.0, 2.5)}}),
        Case("e15", "rope", 15, {"quadratic_drag": {"k": drawn(15, 0.8, 2.5)}}),
        Case("e16", "rope", 16, {"control_lag": {"seconds": drawn(16, 0.02, 0.05)}}),
        Case("e17", "rope", 17, {"tether": line}),
        Case("e18", "rope", 18, {"gust": {"m_s2": 8.0, "from_s": 0.7, "to_s": 0.8}}, ("unexplained",)),
        Case("e19", "cloth", 19, answers=nothing),
        Case("e20", "cloth", 20, {"linear_drag": {"c": drawn(20, 0.8, 2.0)}}),
        Case("e21", "cloth", 21, {"gravity_tilt": {"degrees": drawn(21, 2.5, 5.0), "axis": [0.3, 1.0, 0.0]}}),
        Case("e22", "cloth", 22, {"control_lag": {"seconds": drawn(22, 0.02, 0.05)}}),
        Case("e23", "cloth", 23, {"gust": {"m_s2": 12.0, "from_s": 0.7, "to_s": 0.8}}, ("unexplained",)),
        Case("e24", "brick", 24, answers=nothing),
        Case("e25", "brick", 25, {"control_lag": {"seconds": drawn(25, 0.02, 0.05)}}),
        Case("e26", "finer_blob", 26, answers=nothing),
        Case("e27", "finer_blob", 27, {"gravity_tilt": {"degrees": drawn(27, 3.0, 6.0), "axis": [0.3, 1.0, 0.0]}}),
        Case("e28", "finer_blob", 28, {"internal_viscosity": {"eta": drawn(28, 20.0, 40.0)}}),
        Case("e29", "finer_blob", 29, {"linear_drag": {"c": drawn(29, 1.5, 3.0)}}),
        Case("e30", "capped_blob", 30, answers=nothing),
        Case("e31", "capped_blob", 31, {"linear_drag": {"c": drawn(31, 1.5, 3.0)}}),
        Case("e32", "capped_blob", 32, {"gravity_tilt": {"degrees": drawn(32, 3.0, 6.0), "axis": [0.3, 1.0, 0.0]}}),
        Case("e33", "capped_blob", 33, {"control_lag": {"seconds": drawn(33, 0.02, 0.05)}}),
        Case("e34", "calm_slab", 34, answers=nothing),
        Case("e35", "calm_slab", 35, {"linear_drag": {"c": drawn(35, 1.5, 3.0)}}),
        Case("e36", "calm_slab", 36, {"gravity_tilt": {"degrees": drawn(36, 3.0, 6.0), "axis": [1.0, 0.3, 0.0]}}),
        Case("e37", "beam", 37, {"internal_viscosity": {"eta": drawn(37, 300.0, 800.0)}}),
        Case("e38", "brick", 38, {"linear_drag": {"c": drawn(38, 1.5, 3.0)}}),
        Case("e39", "rope", 39, {"linear_drag": {"c": drawn(39, 1.0, 2.5)},
             "gravity_tilt": {"degrees": drawn(390, 2.5, 5.0), "axis": [1.0, 0.4, 0.0]}}),
        Case("e40", "rope", 40, {"quadratic_drag": {"k": drawn(40, 0.8, 2.5)},
             "control_lag": {"seconds": drawn(400, 0.02, 0.05)}}),
        Case("e41", "cloth", 41, {"linear_drag": {"c": drawn(41, 0.8, 2.0)},
             "gravity_tilt": {"degrees": drawn(410, 2.5, 5.0), "axis": [0.3, 1.0, 0.0]}}),
        Case("e42", "beam", 42, {"internal_viscosity": {"eta": drawn(42, 300.0, 800.0)},
             "gravity_tilt": {"degrees": drawn(420, 2.5, 5.0), "axis": [1.0, 0.4, 0.0]}}),
        Case("e43", "beam", 43, {"linear_drag": {"c": drawn(43, 1.0, 2.5)},
             "control_lag": {"seconds": drawn(430, 0.02, 0.05)}}),
        Case("e44", "beam", 44, {"tether": tether, "linear_drag": {"c": drawn(44, 1.0, 2.5)}}),
    )  # fmt: skip


def kratos_cases() -> tuple[Case, ...]:
    """Recordings by Kratos, half of them without an effect."""

    def drawn(number: int, low: float, high: float) -> float:
        return float(np.random.default_rng(7100 + number).uniform(low, high))

    def drag(number: int) -> dict[str, dict[str, Any]]:
        return {"linear_drag": {"c": drawn(number, 1.5, 3.0)}}

    def tilt(number: int, *axis: float) -> dict[str, dict[str, Any]]:
        return {"gravity_tilt": {"degrees": drawn(number, 3.0, 6.0), "axis": list(axis)}}

    def lag(number: int) -> dict[str, dict[str, Any]]:
        return {"control_lag": {"seconds": drawn(number, 0.02, 0.05)}}

    gust: dict[str, dict[str, Any]] = {"gust": {"m_s2": 10.0, "from_s": 0.7, "to_s": 0.8}}
    bodies = ("taut rope", "thick rope", "lump", "hung slab")
    acting = [("taut rope", drag(11)), ("taut rope", lag(12)), ("thick rope", drag(13)),
              ("thick rope", tilt(14, 1.0, 0.4, 0.0)), ("thick rope", gust), ("lump", drag(16)),
              ("lump", tilt(17, 0.3, 1.0, 0.0)), ("hung slab", drag(18)), ("hung slab", lag(19)),
              ("hung slab", tilt(20, 1.0, 0.3, 0.0))]  # fmt: skip
    silent = [
        Case(f"k{k:02d}", bodies[(k - 1) % 4], 100 + k, answers=("nothing_to_explain",)) for k in range(1, 11)
    ]
    return tuple(silent) + tuple(
        Case(f"k{k:02d}", body, 100 + k, acts, ("unexplained",) if "gust" in acts else CLAIMS)
        for k, (body, acts) in enumerate(acting, start=11)
    )


def solid_cases() -> tuple[Case, ...]:
    """Converged recordings by Kratos, every second one without an effect."""

    def drawn(number: int, low: float, high: float) -> float:
        return float(np.random.default_rng(7200 + number).uniform(low, high))

    acts: dict[int, dict[str, dict[str, Any]]] = {
        2: {"linear_drag": {"c": drawn(2, 1.5, 3.0)}},
        4: {"control_lag": {"seconds": drawn(4, 0.02, 0.05)}},
        6: {"linear_drag": {"c": drawn(6, 1.5, 3.0)}},
        8: {"gravity_tilt": {"degrees": drawn(8, 3.0, 6.0), "axis": [0.3, 1.0, 0.0]}},
    }
    bodies = ("gripped lump", "gripped lump", "thick bar", "thick bar", "corner slab", "corner slab", "gripped lump",
              "gripped lump")  # fmt: skip
    return tuple(
        Case(f"s{k:02d}", body, 200 + k, acts.get(k, {}), CLAIMS if k in acts else ("nothing_to_explain",))
        for k, body in enumerate(bodies, start=1)
    )


def fresh_cases() -> tuple[Case, ...]:
    """Other motions, strengths and noise of bodies whose recorders have converged; the first of every two is silent.

    They were drawn once and traced once, after all of the trace was written.
    """

    def drawn(number: int, low: float, high: float) -> float:
        return float(np.random.default_rng(7300 + number).uniform(low, high))

    def tilt(number: int, *axis: float) -> dict[str, dict[str, Any]]:
        return {"gravity_tilt": {"degrees": drawn(number, 3.0, 6.0), "axis": list(axis)}}

    def lag(number: int) -> dict[str, dict[str, Any]]:
        return {"control_lag": {"seconds": drawn(number, 0.02, 0.05)}}

    def drag(number: int, kind: str = "linear_drag", key: str = "c") -> dict[str, dict[str, Any]]:
        return {kind: {key: drawn(number, 1.0, 2.5)}}

    pairs: tuple[tuple[str, dict[str, dict[str, Any]]], ...] = (
        ("rope", tilt(1, 1.0, 0.4, 0.0)),
        ("rope", drag(2, "quadratic_drag", "k")),
        ("taut rope", drag(3)),
        ("taut rope", tilt(4, 1.0, 0.4, 0.0)),
        ("beam", drag(5)),
        ("beam", {"internal_viscosity": {"eta": drawn(6, 300.0, 800.0)}}),
        ("cloth", drag(7)),
        ("capped_blob", drag(8)),
        ("capped_blob", lag(9)),
        ("calm_slab", lag(10)),
    )
    return _in_pairs("f", 300, pairs)


def opensees_cases() -> tuple[Case, ...]:
    """Recordings by OpenSees, the first of every two without an effect; drawn and traced once."""

    def drawn(number: int, low: float, high: float) -> float:
        return float(np.random.default_rng(7400 + number).uniform(low, high))

    acting: tuple[tuple[str, dict[str, dict[str, Any]]], ...] = (
        ("strung line", {"linear_drag": {"c": drawn(1, 1.5, 3.0)}}),
        ("hung line", {"gravity_tilt": {"degrees": drawn(2, 3.0, 6.0), "axis": [1.0, 0.4, 0.0]}}),
        ("thick line", {"linear_drag": {"c": drawn(3, 1.0, 2.5)}}),
        ("hung plate", {"linear_drag": {"c": drawn(4, 1.5, 3.0)}}),
        ("strung line", {"control_lag": {"seconds": drawn(5, 0.02, 0.05)}}),
        ("hung line", {"control_lag": {"seconds": drawn(6, 0.02, 0.05)}}),
        ("thick line", {"gravity_tilt": {"degrees": drawn(7, 3.0, 6.0), "axis": [1.0, 0.4, 0.0]}}),
        ("hung plate", {"control_lag": {"seconds": drawn(8, 0.02, 0.05)}}),
        ("strung line", {"gravity_tilt": {"degrees": drawn(9, 3.0, 6.0), "axis": [1.0, 0.4, 0.0]}}),
        ("hung line", {"linear_drag": {"c": drawn(10, 1.0, 2.5)}}),
    )
    return _in_pairs("o", 400, acting)


def _in_pairs(
    letter: str, seed: int, acting: tuple[tuple[str, dict[str, dict[str, Any]]], ...]
) -> tuple[Case, ...]:
    """For each body and what acts on it a case without an effect and one with it."""
    silent = ("nothing_to_explain",)
    return tuple(
        case
        for k, (body, acts) in enumerate(acting, start=1)
        for case in (
            Case(f"{letter}{2 * k - 1:02d}", body, seed + 2 * k - 1, answers=silent),
            Case(f"{letter}{2 * k:02d}", body, seed + 2 * k, acts),
        )
    )


SETS = {
    "hidden_effects": cases,
    "hidden_kratos": kratos_cases,
    "hidden_solids": solid_cases,
    "hidden_fresh": fresh_cases,
    "hidden_opensees": opensees_cases,
}
TITLES = {
    "hidden_effects": "Recordings by other engines",
    "hidden_kratos": "Recordings by Kratos Multiphysics",
    "hidden_solids": "Converged recordings by Kratos Multiphysics",
    "hidden_fresh": "Recordings by other engines, judged once",
    "hidden_opensees": "Recordings by OpenSees, judged once",
}
