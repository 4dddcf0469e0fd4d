"""Markup that cannot be forgotten to be escaped: text becomes markup through :func:`tag` only."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

VOID = {"path", "line", "rect", "circle", "img", "input", "br", "meta", "polyline", "image", "polygon"}


class Html(str):
    """Text that is markup already."""

    __slots__ = ()


Child = str | int | float | None | Sequence["Child"]


def tag(name: str, /, *children: Child, **attributes: str | float | bool | None) -> Html:
    """An element; children that are not :class:`Html` are escaped, and so is every attribute.

    Attributes: ``class_`` is ``class``, other underscores are hyphens, None and False leave one out, True has no value.
    """
    parts = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        parts.append(key if value is True else f'{key}="{escape(_text(value), quote=True)}"')
    opening = " ".join(parts)
    if name in VOID and not children:
        return Html(f"<{opening}/>")
    return Html(f"<{opening}>{join(children)}</{name}>")


def scrolled(label: str, *children: Child) -> Html:
    """A part that scrolls by itself where it is wider than the page, with the keyboard too, and has a name to read."""
    return tag("div", *children, class_="scroll", tabindex=0, role="group", aria_label=label)


def join(children: Child) -> Html:
    """Children one after the other, escaped where they are text."""
    if children is None:
        return Html("")
    if isinstance(children, Html):
        return children
    if isinstance(children, list | tuple):
        return Html("".join(join(child) for child in children))
    return Html(escape(_text(children)))


def _text(value: object) -> str:
    """Floats as short as a picture needs them."""
    return f"{value:.7g}" if isinstance(value, float) else str(value)
