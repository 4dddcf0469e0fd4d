"""The lineage of an object as a picture to click through: scene, fit, trace, dataset, model version, uses.

A column for each kind, a box for each object, the newest on top, a line from each to what it was made from. Boxes are
links, so that the keyboard reaches them in their order. A column shows ``MOST_SHOWN`` objects and says how many more
there are; what the object in question was made from is always among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import quote, urlencode

from physworld.report.markup import Html, tag
from physworld_schemas.standing import look_of
from physworld_services.dashboard.site import BASE, Site
from physworld_storage.family import Member, ancestors, family_of, related

MOST_SHOWN = 6
BOX_WIDTH, BOX_HEIGHT, INSET = 148, 42, 11
STEP_X, STEP_Y = 196, 54
TOP = 26
TITLES = ("Scene", "Fits", "Traces", "Datasets", "Model versions", "Uses")
LISTS = {"fit": "fits", "trace": "traces", "dataset": "datasets", "model": "models", "rollout": "rollouts"}
LONGEST = 19
"""Characters of a label; what a wide font makes longer than its box is cut off there."""


def lineage_graph(site: Site, scene_id: str | None, focus: str) -> Html | None:
    """The picture around an object; None where there is no more than the object itself."""
    if scene_id is None:
        return None
    with site.database.reading() as session:
        members = family_of(session, scene_id)
    shown = related(members, focus)
    return drawn(shown, focus) if len(shown) > 1 else None


def drawn(members: Sequence[Member], focus: str) -> Html:
    """The picture of these members."""
    kept = ancestors(members, focus)
    columns = [column for column in range(len(TITLES)) if any(one.column == column for one in members)]
    places: dict[str, tuple[float, float]] = {}
    boxes: list[Html] = []
    height = 0.0
    for across, column in enumerate(columns):
        x = across * STEP_X
        of_column = [one for one in members if one.column == column]
        chosen = _chosen(of_column, kept)
        boxes.append(tag("text", TITLES[column], x=x, y=14, class_="column"))
        for down, member in enumerate(chosen):
            y = TOP + down * STEP_Y
            places[member.key] = (x, y)
            boxes.append(_box(member, x, y, member.key == focus))
        height = max(height, TOP + len(chosen) * STEP_Y)
        if len(chosen) < len(of_column):
            y = TOP + len(chosen) * STEP_Y
            boxes.append(_more(of_column, len(of_column) - len(chosen), members, x, y))
            height = max(height, y + 24)
    lines = [
        _line(places[parent], places[member.key])
        for member in members
        for parent in member.parents
        if parent in places and member.key in places
    ]
    width = (len(columns) - 1) * STEP_X + BOX_WIDTH
    return tag(
        "svg",
        lines,
        boxes,
        role="group",
        aria_label="Lineage",
        class_="lineage",
        viewBox=f"-3 0 {width + 6} {height:g}",
        width=width + 6,
        height=height,
    )


def address_of(member: Member) -> str:
    """The page of an object."""
    if member.kind == "model":
        name, _, version = member.key.rpartition(":")
        return f"{BASE}/models/{quote(name)}/{version}"
    return f"{BASE}/{member.kind}s/{quote(member.key)}"


def _chosen(members: Sequence[Member], kept: set[str]) -> list[Member]:
    """The newest of a column, and those that have to be there."""
    free = MOST_SHOWN - sum(member.key in kept for member in members)
    chosen = []
    for member in members:
        if member.key in kept:
            chosen.append(member)
        elif free > 0:
            chosen.append(member)
            free -= 1
    return chosen


def _box(member: Member, x: float, y: float, here: bool) -> Html:
    said = f"{member.kind} {member.label}{f', {member.state}' if member.state else ''}"
    texts = [tag("text", _cut(member.label), y=18 if member.state else 26)]
    if member.state:
        texts.append(tag("text", member.state, y=34, class_=f"state {look_of(member.state)}"))
    parts = [
        tag("title", f"{member.kind} {member.key}{f', {member.state}' if member.state else ''}"),
        tag("rect", x=x, y=y, width=BOX_WIDTH, height=BOX_HEIGHT, rx=7),
        tag("svg", texts, x=x + INSET, y=y, width=BOX_WIDTH - 2 * INSET, height=BOX_HEIGHT),
    ]
    current = "true" if here else None
    return tag("a", parts, href=address_of(member), aria_label=said, aria_current=current, class_=member.kind)


def _more(column: Sequence[Member], count: int, members: Sequence[Member], x: float, y: float) -> Html:
    """How many are not shown, with the list that has them where there is one."""
    said = tag("text", f"and {count} more", x=x + 11, y=y + 12, class_="state")
    kind = column[0].kind
    if kind not in LISTS:
        return said
    scene = next((one.label for one in members if one.kind == "scene"), "")
    words = {} if kind in ("model", "rollout") else {"q": scene}
    return tag(
        "a",
        said,
        href=f"{BASE}/{LISTS[kind]}?{urlencode(words)}",
        aria_label=f"and {count} more {LISTS[kind]}",
    )


def _line(parent: tuple[float, float], child: tuple[float, float]) -> Html:
    x0, y0 = parent[0] + BOX_WIDTH, parent[1] + BOX_HEIGHT / 2
    x1, y1 = child[0], child[1] + BOX_HEIGHT / 2
    bend = min(24.0, (x1 - x0) / 2)
    path = f"M{x0:g} {y0:g}C{x0 + bend:g} {y0:g} {x0 + bend:g} {y1:g} {x0 + 2 * bend:g} {y1:g}H{x1:g}"
    return tag("path", d=path)


def _cut(label: str) -> str:
    return label if len(label) <= LONGEST else f"{label[: LONGEST - 1]}…"
