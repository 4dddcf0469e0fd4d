"""``python -m benchmarks.paper.unseen_motion --json FILE``: motions of a kind that the training did not see.

A world model of the sample scene is trained on every pattern of motion but one (and on no replay of the recording),
another one on all of them. Both are rolled out over HORIZON frames of episodes of the pattern left out and compared
with the twin, vertex by vertex, open loop from the first ``history`` + 1 frames, beside holding still and following
the grip rigidly. ``largest_m`` is the worst mean over vertices of any frame of any episode: how far the error goes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, run_alone
from benchmarks.paper.models import EPISODES, SMALL, Case, case_of, demonstrations, horizon_errors, learn
from physworld.demonstrate import DemonstrationConfig
from physworld.demonstrate.limits import limits_of
from physworld.demonstrate.patterns import patterns_for
from physworld.worldmodel.model.model import WorldModel

HORIZON = 100
SHOWN = (10, 25, 50, 100)
JUDGED = 8
JUDGE_SEED = 90_000  # none of the training's
KINDS = ("twist", "lift")
CELLS = Path(".bench") / "unseen_motion"


def cell(case: Case, seed: int) -> dict[str, dict[str, Any]]:
    """Errors over the horizon on episodes of each kind: trained without it, and with all kinds [m]."""
    known = patterns_for(limits_of(case.scene, case.twin), case.scene.control_track()[1][0])
    if not set(KINDS) <= set(known):
        raise ValueError(f"the scene allows {', '.join(known)}, not all of {', '.join(KINDS)}")
    frames = HORIZON + SMALL.history + 1
    whole = _trained(case, known, seed)
    found: dict[str, dict[str, Any]] = {}
    for kind in KINDS:
        judged, _ = demonstrations(case, _only((kind,), frames), JUDGED, JUDGE_SEED + seed)
        parts: dict[str, Any] = {"size_m": float(np.ptp(case.twin.particles_rest, axis=0).max())}
        without = _trained(case, tuple(other for other in known if other != kind), seed)
        for name, model in (("unseen", without), ("seen", whole)):
            errors = horizon_errors(model, case.view.spec, judged)
            parts[name] = _summary(errors["world_model"])
            parts["baselines"] = {key: _summary(errors[key]) for key in ("static", "rigid_follow")}
        found[kind] = parts
    return found


def pooled(cells: list[dict[str, Any] | None]) -> dict[str, Any] | None:
    """Mean and standard deviation over seeds of every figure; None when there is no cell."""
    there = [one for one in cells if one is not None]
    if not there:
        return None
    sources = {
        "unseen": [one["unseen"] for one in there],
        "seen": [one["seen"] for one in there],
        **{name: [one["baselines"][name] for one in there] for name in ("static", "rigid_follow")},
    }
    figures: dict[str, Any] = {"seeds": len(there), "size_m": there[0]["size_m"]}
    for name, of_seeds in sources.items():
        figures[name] = {
            key: {
                "mean": float(np.mean([one[key] for one in of_seeds])),
                "std": float(np.std([one[key] for one in of_seeds], ddof=1)) if len(there) > 1 else 0.0,
            }
            for key in ("mean_m", "largest_m")
        }
        figures[name]["at_frame_m"] = {
            frame: float(np.mean([one["at_frame_m"][frame] for one in of_seeds]))
            for frame in of_seeds[0]["at_frame_m"]
        }
    return figures


def in_words(kind: str, found: dict[str, Any]) -> str:
    """One line."""
    parts = []
    for name, label in (
        ("unseen", "trained without it"),
        ("seen", "with it"),
        ("rigid_follow", "rigid follow"),
        ("static", "static"),
    ):
        mean, largest = found[name]["mean_m"], found[name]["largest_m"]
        spread = f" ± {1e3 * mean['std']:.2g}" if found["seeds"] > 1 else ""
        parts.append(f"{label} {1e3 * mean['mean']:.2f}{spread} (at most {1e3 * largest['mean']:.3g})")
    return f"Motion `{kind}`, {HORIZON} frames, distance from the twin in mm: {'; '.join(parts)}."


def measure(repeats: int, seed: int) -> Report:
    """All kinds, ``repeats`` seeds from ``seed`` on."""
    case = case_of("soft_beam", CELLS)
    assert case is not None, "the sample scene is part of the repository"
    cells = [cell(case, seed + k) for k in range(repeats)]
    figures = {kind: pooled([one[kind] for one in cells]) for kind in KINDS}
    rows = []
    for kind, found in figures.items():
        assert found is not None
        for name, label in (
            ("unseen", "world model, trained without it"),
            ("seen", "world model, trained with it"),
            ("rigid_follow", "rigid follow"),
            ("static", "static"),
        ):
            at = [f"{1e3 * found[name]['at_frame_m'][str(frame)]:.2f}" for frame in SHOWN]
            mean = found[name]["mean_m"]
            largest = f"{1e3 * found[name]['largest_m']['mean']:.2f}"
            rows.append([kind, label, f"{1e3 * mean['mean']:.2f} ± {1e3 * mean['std']:.2g}", *at, largest])
    return Report(
        name="unseen_motion",
        title="Motions of a kind that the training did not see",
        figures=figures,
        header=["kind", "prediction", "mean, mm", *(f"frame {frame}" for frame in SHOWN), "largest"],
        rows=rows,
        notes=[
            f"Sample scene; distance from the twin, mean over vertices and {JUDGED} episodes a seed, {repeats} seeds; "
            f"{EPISODES} training episodes.",
        ],
        seed=seed,
    )


def _trained(case: Case, kinds: tuple[str, ...], seed: int) -> WorldModel:
    """A small model of demonstrations of these patterns alone."""
    episodes, _ = demonstrations(case, _only(kinds, None), EPISODES, seed)
    return learn(case.view.spec, episodes, seed).model


def _only(kinds: tuple[str, ...], frames: int | None) -> DemonstrationConfig:
    """Demonstrations of these patterns alone, without replays of the recording."""
    return DemonstrationConfig(frames=frames, patterns=dict.fromkeys(kinds, 1.0), replay_share=0.0)


def _summary(errors: np.ndarray) -> dict[str, Any]:
    """Of errors (episodes, frames) [m]."""
    curve = errors.mean(axis=0)
    return {
        "mean_m": float(errors.mean()),
        "largest_m": float(errors.max()),
        "at_frame_m": {str(frame): float(curve[frame - 1]) for frame in SHOWN},
        "curve_m": [float(value) for value in curve],
    }


if __name__ == "__main__":
    run_alone(measure)
