"""Numbers and verdicts in words that claim no more than the report does."""

from __future__ import annotations

import math
from typing import Any

from physworld.report.names import label

VERDICTS = {
    "named": ("Effect named", "good"),
    "equivalent_set": ("Equivalent set", "warn"),
    "data_issue": ("Data issue", "warn"),
    "numerical_issue": ("Numerical issue", "warn"),
    "unexplained": ("Unexplained", "bad"),
    "nothing_to_explain": ("Nothing to explain", "good"),
}
"""Title and tone of every verdict."""

_PREFIXES = {
    "Pa": ((1e6, "MPa"), (1e3, "kPa")),
    "m": ((1.0, "m"), (1e-3, "mm")),
    "s": ((0.1, "s"), (1e-3, "ms")),
}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """Short, without an exponent where that is readable; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
        text = f"{value:.{min(decimals, 6)}f}"
        return text
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPTS)}"


def scaled(values: list[float | None], unit: str) -> tuple[list[float | None], str]:
    """Values in a unit whose prefix suits the largest of them."""
    largest = max((abs(v) for v in values if v is not None and math.isfinite(v)), default=0.0)
    for factor, name in _PREFIXES.get(unit, ()):
        if largest >= factor or ((factor, name) == _PREFIXES[unit][-1] and unit != "Pa"):
            return [None if v is None else v / factor for v in values], name
    return values, "" if unit == "1" else unit


def quantity(value: float | None, unit: str) -> str:
    """A number with its unit; angles in degrees too."""
    (shown,), name = scaled([value], unit)
    degrees = f" ({number(math.degrees(value))}°)" if unit == "rad" and value is not None else ""
    return f"{number(shown)} {name}".strip() + degrees


def interval(figure: dict[str, Any]) -> str:
    """``low to high unit`` of a figure's 95 % interval; empty without one."""
    ends = figure.get("ci95")
    if not ends or any(end is None for end in ends):
        return ""
    (low, high), name = scaled(list(ends), figure.get("unit", "1"))
    return f"{number(low)} to {number(high)} {name}".strip()


def millimetres(value: float | None) -> str:
    """A length for people [mm]."""
    return "–" if value is None else f"{number(1e3 * value)} mm"


def title(effect: dict[str, Any] | str) -> str:
    """An effect's words: its title where the report has it, else its name."""
    if isinstance(effect, str):
        return effect.replace("_", " ")
    return str(effect.get("title") or str(effect.get("name", "")).replace("_", " "))


def headline(report: dict[str, Any]) -> str:
    """The verdict in one honest sentence."""
    tried = len(report.get("candidates", []))
    among = f"among {tried} candidates"
    effects = " with ".join(_with_strength(effect) for effect in report.get("effects", []))
    others = ", ".join(title(effect) for effect in report.get("equivalent", []))
    kind = report.get("verdict")
    if kind == "named":
        return f"Best supported {among}: {effects}."
    if kind == "equivalent_set":
        return f"Best supported {among}: {effects}, or as well {others}; these data cannot tell them apart."
    if kind == "data_issue" and not effects:
        return "The recording has faulty sightings; without them the declared physics is within the noise."
    if kind == "data_issue":
        also = f" (or as well {others})" if others else ""
        return f"Best supported {among}: a fault of the measurement, not of the physics: {effects}{also}."
    if kind == "numerical_issue":
        return "No effect is claimed: finer cells change the twin by as much as is left."
    if kind == "unexplained":
        return f"Something is there that none {_of(tried)} accounts for; it is described below, not forced into a name."
    if kind == "nothing_to_explain":
        return f"The declared physics is within the noise, and none {_of(tried)} explains more."
    return str(kind or "no verdict")


def _of(tried: int) -> str:
    return f"of {tried} candidates"


def _with_strength(effect: dict[str, Any]) -> str:
    """``title, number value unit``, by the effect's numbers that were estimated; the interval where it is one."""
    known = {name: figure for name, figure in effect.get("parameters", {}).items() if interval(figure)}
    parts = [f"{label(name)} {_plain(figure)}" for name, figure in known.items()]
    if len(known) == 1:
        figure = next(iter(known.values()))
        return f"{title(effect)}, {parts[0]} (95 %: {interval(figure)})"
    return f"{title(effect)}, {' and '.join(parts[:3])}" if parts else title(effect)


def _plain(figure: dict[str, Any]) -> str:
    (value,), unit = scaled([figure.get("value")], figure.get("unit", "1"))
    return f"{number(value)} {unit}".strip()
