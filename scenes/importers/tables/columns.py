"""What the head of a column means: whose coordinate, along which axis, in which unit; a time, a count, a name."""

from __future__ import annotations

import re
from dataclasses import dataclass

TIME = re.compile(
    r"^(t|times?|seconds?|secs?|timestamps?|time[ _-]?stamps?|elapsed([ _]?time)?|clock)"
    r"[ _]*[(\[]?[ ]*(?P<unit>s|sec|seconds?|ms|msec|milliseconds?|us|microseconds?|ns|nanoseconds?)?[ ]*[)\]]?$",
    re.IGNORECASE,
)
TIME_UNITS = {"s": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}
FRAME = re.compile(
    r"^(frames?#?|frame[ _]?(no|nr|number|id|index|idx)|index|idx|samples?|sub[ _]frame|step|)$",
    re.IGNORECASE,
)
MARKER_NAME = re.compile(
    r"^(markers?|points?|labels?|names?|ids?|tracks?|particles?|nodes?)[ _]?(id|name|label|nr|no|index)?$",
    re.IGNORECASE,
)
BRACKETED = re.compile(r"[ _]*[(\[][ ]*([a-z]+)[ ]*[)\]]$", re.IGNORECASE)
UNIT_AFTER_MARK = re.compile(r"[ _](mm|cm|m)$", re.IGNORECASE)
AXIS_LAST = re.compile(
    r"^(?P<name>.+?)[ _.:/\-|]+(?:t|p|pos|position|trans|translation|coord)?[ _.:/\-|]*(?P<axis>[xyz])$",
    re.IGNORECASE,
)
AXIS_CAPITAL = re.compile(r"^(?P<name>.*[a-z0-9)])(?P<axis>[XYZ])$")
AXIS_AFTER_NUMBER = re.compile(r"^(?P<name>.*\d)(?P<axis>[xyz])$", re.IGNORECASE)
AXIS_FIRST = re.compile(
    r"^(?:t|p|pos|position)?[ _.]?(?P<axis>[xyz])(?:[ _.:/\-|\[(]+(?P<name>[^\])]+)[\])]?|(?P<number>\d+))$",
    re.IGNORECASE,
)
AXIS_ALONE = re.compile(r"^(?:t|p|pos|position|coord)?[ _.]?(?P<axis>[xyz])$", re.IGNORECASE)
NO_PLACE = re.compile(
    r"(^|[ _.:/])(v|vel|velocity|acc|accel|acceleration|rot|rotation|euler|angles?|force|moment|torque|omega|gyro"
    r"|q|quat|quaternion|orientation|normal|speed)([ _.:/]|$)",
    re.IGNORECASE,
)
"""Heads of other vectors than places."""
UNITS = {"mm": "mm", "cm": "cm", "m": "m", "in": "in"}


@dataclass(frozen=True)
class Head:
    """The head of a column: its text, and of a coordinate the marker's name ('' for the only one), axis and unit."""

    text: str
    name: str = ""
    axis: str = ""
    unit: str = ""


def head_of(text: str) -> Head:
    """What a head says."""
    bare, unit = text.strip(), ""
    match = BRACKETED.search(bare) or UNIT_AFTER_MARK.search(bare)
    if match and match.group(1).lower() in UNITS and match.start() > 0:
        bare, unit = bare[: match.start()].rstrip(" _"), UNITS[match.group(1).lower()]
    if TIME.match(bare) or is_frame(bare) or NO_PLACE.search(bare):
        return Head(text.strip())
    for form in (AXIS_ALONE, AXIS_LAST, AXIS_CAPITAL, AXIS_FIRST, AXIS_AFTER_NUMBER):
        found = form.match(bare)
        if found:
            parts = found.groupdict()
            name = (parts.get("name") or parts.get("number") or "").strip(" _.:/-|")
            return Head(text.strip(), name, found.group("axis").lower(), unit)
    return Head(text.strip())


def time_unit_of(text: str) -> float | None:
    """Seconds a unit of a column of times; None if the head is of no time."""
    match = TIME.match(text.strip())
    if match is None:
        return None
    word = (match.group("unit") or "s").lower()
    return TIME_UNITS[
        "m"
        if word.startswith("mi") and not word.startswith("mic")
        else "u"
        if word.startswith("mic")
        else word[0]
    ]


def is_frame(text: str) -> bool:
    """Whether a column counts frames."""
    return FRAME.match(text.strip()) is not None


def is_marker_name(text: str) -> bool:
    """Whether a column names markers."""
    return MARKER_NAME.match(text.strip()) is not None
