"""Words for times, durations and quantities on the pages; the filters of every template."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from markupsafe import Markup, escape

from physworld.report import names
from physworld.report.markup import Html
from physworld_schemas.standing import look_of
from physworld_schemas.wording import roughly
from physworld_services.dashboard.tables import label_of

_AGES = ((60, 1, "s"), (3600, 60, "min"), (86_400, 3600, "h"), (30 * 86_400, 86_400, "d"))
DASH = "–"
NEXT_TO_NOTHING = 1e-6


def utc_now() -> datetime:
    """The present, aware, in UTC."""
    return datetime.now(UTC)


def ago(when: datetime, now: datetime | None = None) -> str:
    """``3 min ago``; the date for what is older than a month. ``frontend/src/app.js`` keeps counting."""
    seconds = ((now or utc_now()) - when).total_seconds()
    if seconds < 2:
        return "just now"
    for limit, unit, name in _AGES:
        if seconds < limit:
            return f"{int(seconds // unit)} {name} ago"
    return when.strftime("%Y-%m-%d")


def moment(when: datetime | None) -> Markup:
    """A ``<time>`` element: relative words, the absolute time as its title."""
    if when is None:
        return Markup(DASH)  # nosec B704
    absolute = when.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    stamp = when.astimezone(UTC).isoformat()
    return Markup('<time datetime="{}" title="{}" data-ago>{}</time>').format(stamp, absolute, ago(when))


def duration(seconds: float | None) -> str:
    """``0.4 s``, ``12 s``, ``3 min 20 s``, ``2 h 05 min``."""
    if seconds is None or not math.isfinite(seconds):
        return DASH
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def lasted(start: datetime | None, end: datetime | None) -> Markup | str:
    """Duration between two moments; counted on by the browser where the end is open."""
    if start is None:
        return DASH
    if end is not None:
        return duration((end - start).total_seconds())
    stamp = start.astimezone(UTC).isoformat()
    return Markup('<time datetime="{}" data-since>{}</time>').format(stamp, span(start))


def span(start: datetime) -> str:
    """Duration from a moment until now."""
    return duration((utc_now() - start).total_seconds())


def figure(value: object, digits: int = 4) -> str:
    """A number with ``digits`` significant digits; thousands apart, powers of ten where they are shorter."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return DASH
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, list | tuple):
        return ", ".join(figure(item, digits) for item in value) or DASH
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return DASH
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"
    text = _fixed(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text else text


def millimetres(metres: float | None) -> str:
    """A length in metres as millimetres with three significant digits, without the unit."""
    if metres is None or not math.isfinite(metres):
        return DASH
    return _fixed(float(metres) * 1000, 3)


def shown_unit(unit: str) -> str:
    """The unit in which :func:`measured` shows a value, with a comma before it; nothing where there is none."""
    return "" if unit == "1" else f", {'mm' if unit == 'm' else names.written(unit)}"


def measured(value: float | None, unit: str) -> str:
    """A value of a metric without its unit: lengths as millimetres, others as they are."""
    return millimetres(value) if unit == "m" else figure(value, 3)


def _fixed(value: float, digits: int) -> str:
    """Decimal notation with ``digits`` significant digits, zeros at the end kept; what is next to nothing is 0."""
    if 0 < abs(value) < NEXT_TO_NOTHING:
        return "0"
    value = abs(value) if value == 0 else value  # a zero has no sign
    places = digits - 1 - math.floor(math.log10(abs(value))) if value else digits - 1
    return f"{value:,.{max(0, places)}f}"


def size(count: int) -> str:
    """Bytes in the binary units that file managers use."""
    value = float(count)
    for unit in ("bytes", "KiB", "MiB"):
        if value < 1024:
            return f"{value:.0f} {unit}" if unit == "bytes" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} GiB"


def amount(count: float, unit: str) -> str:
    """``12 runs``, ``1 run``, ``87 %``: a count with its unit, which is given in the plural."""
    if unit == "percent":
        return f"{count:.0f} %"
    return f"{figure(count)} {unit.removesuffix('s') if count == 1 else unit}".strip()


def progress_told(done: float, total: float | None, unit: str) -> str:
    """How far something has come: ``20 of 80 simulations``, ``87 %``; empty where nobody knows."""
    if not total:
        return ""
    return (
        amount(100 * done / total, unit) if unit == "percent" else f"{figure(done)} of {amount(total, unit)}"
    )


def coded(text: str) -> Markup:
    """A sentence of the schemas, its parts between backticks as code."""
    parts = text.split("`")
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if number % 2 else escape(part)
        for number, part in enumerate(parts)
    )


def uncoded(text: str) -> str:
    """The same where there is no markup."""
    return text.replace("`", "")


def identifier(value: str) -> Markup:
    """A long id or digest, cut to its end, the whole of it in the title."""
    short = (
        value if len(value) <= 16 else f"{value[:4]}…{value[-6:]}" if "_" in value[:4] else f"{value[:12]}…"
    )
    return Markup('<span class="mono nowrap" title="{}">{}</span>').format(value, short)


def plain(value: object) -> str:
    """A declared fact of any shape, as one line."""
    if isinstance(value, dict):
        told = {str(key): item for key, item in value.items() if item not in (None, [], ())}
        return ", ".join(
            f"{names.label(key)} {plain(item)} {names.unit(key)}".strip() for key, item in told.items()
        )
    if value in ("", [], ()):
        return DASH
    if isinstance(value, list | tuple):
        if len(value) > 6:
            return f"{len(value)} entries"
        return "(" + ", ".join(plain(item) for item in value) + ")"
    return figure(value)


def markup(drawn: Html) -> Markup:
    """A picture of ``physworld.report``, whose every text is escaped already."""
    return Markup(drawn)  # nosec B704


FILTERS = {
    "markup": markup,
    "moment": moment,
    "duration": duration,
    "figure": figure,
    "measured": measured,
    "millimetres": millimetres,
    "shown_unit": shown_unit,
    "roughly": roughly,
    "size": size,
    "amount": amount,
    "coded": coded,
    "uncoded": uncoded,
    "words": names.label,
    "name": names.title,
    "unit": names.written,
    "sentence": names.sentence,
    "predictor": label_of,
    "identifier": identifier,
    "look": look_of,
    "plain": plain,
}
