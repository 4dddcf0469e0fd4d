"""Names of fields as people read them: ``youngs_modulus_pa`` is Young's modulus, in Pa.

The one place that turns the name of a field of a body, a report or a scene into words and a unit. A name ends in its
unit, which is made of symbols (``_m_s2``); what it does not say without doubt (``n_m`` is N/m or N m) is in the schema.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

_SYMBOL = r"(?:kg|pa|rad|deg|hz|px|db|m|s|n)\d?"
_UNIT_AT_THE_END = re.compile(rf"(?<=[^_])_((?:per_)?{_SYMBOL}(?:_{_SYMBOL})*)$")
_UNITS = {
    "m": "m", "s": "s", "kg": "kg", "n": "N", "pa": "Pa", "rad": "rad", "deg": "deg", "hz": "Hz", "px": "px",
    "db": "dB", "m_s": "m/s", "m_s2": "m/s²", "kg_m": "kg/m", "kg_m2": "kg/m²", "kg_m3": "kg/m³", "pa_s": "Pa s",
    "per_m": "1/m", "per_s": "1/s", "per_pa": "1/Pa",
}  # fmt: skip
_SPELLED = {
    "youngs": "Young's",
    "poissons": "Poisson's",
    "phi": "Φ",
    "ci95": "95 % interval",
    "config": "settings",
    "finetuned": "fine-tuned",
}
"""Words that a name of ASCII letters cannot spell."""


def label(name: str) -> str:
    """A field's name in words, without the unit at its end; ``scene_id`` is the scene.

    Args:
        name: ``youngs_modulus_pa``, or with its place, ``validation.open_loop_m``.
    """
    first, *rest = (_words(_UNIT_AT_THE_END.sub("", part)) for part in name.split("."))
    return f"{first}: {' '.join(rest)}" if rest else first


def unit(name: str) -> str:
    """The unit at the end of a field's name, as people write it; empty where the name does not tell it."""
    found = _UNIT_AT_THE_END.search(name)
    return _UNITS.get(found[1], "") if found else ""


def written(symbols: str) -> str:
    """A declared unit with its powers raised: ``kg/m^3`` as ``kg/m³``; empty for ``1``, which is none."""
    return "" if symbols == "1" else symbols.replace("^2", "²").replace("^3", "³")


def title(name: str) -> str:
    """The label at the beginning of a line, with the unit of the value beside it: ``Density [kg/m³]``."""
    told = unit(name)
    return sentence(label(name)) + (f" [{told}]" if told else "")


def sentence(words: str) -> str:
    """Words with a capital at their beginning."""
    return words[:1].upper() + words[1:]


def reworded(text: str, fields: Iterable[str]) -> str:
    """A sentence with the names of fields in it as words: ``shows air_drag_linear`` as ``shows air drag linear``.

    Args:
        text: the sentence.
        fields: names that may be in it; a longer one goes before one that it contains.
    """
    for field in sorted(set(fields), key=len, reverse=True):
        text = text.replace(field, label(field))
    return text


def _words(name: str) -> str:
    name = re.sub(r"(?<=[^_])_id(s?)$", r"\1", name)
    return " ".join(_SPELLED.get(word, word) for word in name.strip("_").split("_"))
