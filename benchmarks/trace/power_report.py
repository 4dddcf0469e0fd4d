"""What ``benchmarks.trace.power`` counts: outcomes by effect and level, detection limits, false names; its page."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from scipy.stats import beta

from benchmarks.harness import Report
from benchmarks.trace.power_effects import LEVELS
from benchmarks.trace.power_objects import NULLS_ONLY
from physworld.effects.registry import EFFECTS

Row = dict[str, Any]
CLAIMS = ("named", "equivalent_set", "data_issue")
RIGHT, SET, PARTLY, WRONG = "right", "in a set", "with another", "wrong name"
SILENT = ("unexplained", "numerical_issue", "nothing_to_explain")
NOT_RUN = ("refused", "failed")
_HALF = 0.5  # share of the objects on which an effect must be found at its detection limit
_SMALL_SET = 2  # effects in an answer that still says something
CLAIMED = (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)  # edges of posteriors that are counted together


def outcome(row: Row) -> str:
    """What an answer is worth: one of RIGHT, SET, PARTLY, WRONG, the silent verdicts, ``refused``, ``failed``."""
    if row["outcome"] not in CLAIMS:
        return str(row["outcome"])
    names, others = row["names"], row["equivalent"]
    if row["effect"] not in {*names, *others}:
        return WRONG
    if names == [row["effect"]] and not others:
        return RIGHT
    if len(names) == 1 and len({*names, *others}) <= _SMALL_SET:
        return SET
    return PARTLY


def column(row: Row) -> str:
    """Where an answer stands in the confusion matrix: the effect itself if the answer holds it, else what it said."""
    if row["outcome"] not in CLAIMS:
        return str(row["outcome"])
    return row["effect"] if row["effect"] in {*row["names"], *row["equivalent"]} else row["names"][0]


def interval(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson interval of a rate."""
    if not trials:
        return 0.0, 1.0
    tail = 0.5 * (1.0 - level)
    low = float(beta.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1.0 - tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


@dataclass(frozen=True)
class Limit:
    """Smallest level at which an effect was found on at least half, and on all, of the objects that ran at that level.

    ``sizes`` are its strengths there by object with their units; a level is None where it was found at none.
    """

    half: float | None
    every: float | None
    sizes: dict[str, tuple[float, str]]


def limit(rows: list[Row], effect: str) -> Limit:
    """The detection limit of an effect. Found: alone, or in a set of at most two."""
    half = every = None
    sizes: dict[str, tuple[float, str]] = {}
    for level in LEVELS:
        ran = [
            r for r in rows if r["effect"] == effect and r["level"] == level and r["outcome"] not in NOT_RUN
        ]
        found = [r for r in ran if outcome(r) in (RIGHT, SET)]
        if not ran:
            continue
        if half is None and len(found) >= _HALF * len(ran):
            half = level
            sizes = {r["object"]: (r["size"], r["unit"]) for r in found}
        if every is None and len(found) == len(ran):
            every = level
    return Limit(half, every, sizes)


def calibration(rows: list[Row]) -> list[dict[str, float]]:
    """How often what has a posterior is what acts: over all recordings but those of the engine that damps, every set of
    effects with its posterior is a claim, and right where it is the one effect that acts."""
    claims = [
        (posterior, effects == [row["effect"]])
        for row in rows
        if row["outcome"] not in NOT_RUN and row["object"] != NULLS_ONLY
        for effects, posterior in row.get("posterior", ())
        if effects
    ]
    found = []
    for low, high in pairwise(CLAIMED):
        inside = [claim for claim in claims if low < claim[0] <= high]
        right = sum(claim[1] for claim in inside)
        claimed = sum(claim[0] for claim in inside) / max(len(inside), 1)
        below, above = interval(right, len(inside))
        found.append({"from": low, "to": high, "claims": len(inside), "claimed": claimed, "right": right,
                      "low": below, "high": above})  # fmt: skip
    return found


def summary(rows: list[Row], planned: int) -> dict[str, Any]:
    """All counts."""
    nulls = [r for r in rows if r["effect"] is None and r["outcome"] not in NOT_RUN]
    own = [r for r in nulls if r["object"] != NULLS_ONLY]
    false = sum(r["outcome"] in CLAIMS for r in own)
    injected = [r for r in rows if r["effect"] is not None and r["outcome"] not in NOT_RUN]
    limits = {name: limit(rows, name) for name in EFFECTS}
    return {
        "run": len(rows),
        "planned": planned,
        "injected": len(injected),
        "nulls": {
            "scenes": len(own),
            "false_names": false,
            "rate": false / len(own) if own else None,
            "ci95": interval(false, len(own)),
            "verdicts": dict(Counter(r["outcome"] for r in own)),
            "damped": dict(Counter(r["outcome"] for r in nulls if r["object"] == NULLS_ONLY)),
        },
        "outcomes": {
            f"{level:g}": dict(Counter(outcome(r) for r in injected if r["level"] == level)) for level in LEVELS
        },
        "calibration": calibration(rows),
        "limits": {
            name: {"half": known.half, "every": known.every, "strengths": known.sizes} for name, known in limits.items()
        },
        "commits": dict(Counter(f"{r['commit']}{'+' if r['changed'] else ''}" for r in rows)),
        "cpu_s": sum(r.get("cpu_s", 0.0) for r in rows),
    }  # fmt: skip


class Page(Report):
    """The report with more than one table."""

    def markdown(self) -> str:
        """The table of effects, between what was run and the false names."""
        text = super().markdown()
        head, rest = text.split("\n", 1)
        return "\n".join([head, "", self.figures["lead"], rest])


def page(
    rows: list[Row], figures: dict[str, Any], planned: int, pictures: tuple[str, str], seed: int
) -> Report:
    """The page in ``docs/``, with the confusion matrix and the curve of how often claims are right."""
    nulls, (picture, curve) = figures["nulls"], pictures
    low, high = nulls["ci95"]
    lead = (
        f"{len(rows)} of {planned} traces were run (refused ones included). **False names: {nulls['false_names']} on "
        f"{nulls['scenes']} recordings without an effect** "
        f"(95 % interval {low:.1%} to {high:.1%}, Clopper-Pearson); their verdicts: {_counts(nulls['verdicts'])}. "
        f"On those of the engine that damps: {_counts(nulls['damped'])}.\n\n"
        f"![Confusion matrix: what acts, and what was answered, at three strengths]({picture})\n\n"
        f"![How often a claim is right, over its posterior]({curve})\n\n"
        "Level: displacement by the effect, root mean square per axis over the training frames, over the noise "
        f"(1 mm). Every cell lists the objects in the order beam, rope, sheet (ground effects: pad): "
        "**+** named, **(+)** in an equivalent set of two, **±** among more, **!** another name, **·** unexplained, "
        "**#** numerical issue, **-** nothing to explain, **x** refused, **?** not run. "
        "A level in italics was cut by the registry's bound on some object. The limit is the smallest level found "
        "(+ or (+)) on at least half of the objects, with the strengths there; all: on every object."
    )
    header = ["effect", *(f"level {level:g}" for level in LEVELS), "limit", "all", "strength at the limit"]
    table = [_effect_row(rows, name, figures["limits"][name]) for name in EFFECTS]
    notes = [f"Level {level}: {_counts(counts)}." for level, counts in figures["outcomes"].items() if counts]
    wrong = Counter((r["effect"], column(r)) for r in rows if r["effect"] and outcome(r) == WRONG)
    if wrong:
        named = "; ".join(f"{what} for {acts} ({count})" for (acts, what), count in wrong.most_common())
        notes.append(f"Other names than what acts: {named}.")
    false = Counter(" + ".join(r["names"]) for r in rows if r["effect"] is None and r["outcome"] in CLAIMS)
    if false:
        notes.append(f"Named where nothing acts: {', '.join(f'{n} ({c})' for n, c in false.most_common())}.")
    claims = "; ".join(
        f"{one['from']:g} to {one['to']:g}: {one['right']} of {one['claims']}"
        for one in figures["calibration"]
        if one["claims"]
    )
    notes.append(f"Claims that are right, by posterior: {claims}.")
    notes.append(
        f"Commits of the method (+: with changes that were not committed): {_counts(figures['commits'])}; "
        f"{figures['cpu_s'] / 60:.0f} minutes of one core."
    )
    return Page(
        name="trace_power", title="Power and false names", figures={**figures, "lead": lead}, header=header,
        rows=table, notes=notes, seed=seed,
    )  # fmt: skip


_SIGNS = {
    RIGHT: "+", SET: "(+)", PARTLY: "±", WRONG: "!", "unexplained": "·", "numerical_issue": "#",
    "nothing_to_explain": "-", "refused": "x", "failed": "f",
}  # fmt: skip


def _effect_row(rows: list[Row], name: str, known: dict[str, Any]) -> list[str]:
    cells = []
    for level in LEVELS:
        here = {r["object"]: r for r in rows if r["effect"] == name and r["level"] == level}
        bodies = ["pad"] if "pad" in here else ["beam", "rope", "sheet"]
        text = " ".join(_SIGNS[outcome(here[b])] if b in here else "?" for b in bodies)
        cells.append(f"*{text}*" if any(r.get("clipped") for r in here.values()) else text)
    sizes = ", ".join(f"{body} {size:.2g} {unit}" for body, (size, unit) in known["strengths"].items())
    at = ["none" if level is None else f"{level:g}" for level in (known["half"], known["every"])]
    ran = any(r["effect"] == name and r["outcome"] not in NOT_RUN for r in rows)
    return [f"`{name}`", *cells, *(at if ran else ("?", "?")), sizes or "-"]


def _counts(counts: dict[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in ordered) or "none run"
