"""Maps of a prediction's residual over the points of a body and the frames: where and when it errs."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from physworld.arrays import Array
from physworld.report.curves import Residuals, carpet
from physworld.report.markup import Child, Html, scrolled, tag
from physworld.report.svg import Axes, drawings, picture
from physworld.report.words import number

MM = 1e3
MOST_FRAMES = MOST_ROWS = 600
"""Cells of a map across and down; where points share a row, it shows the largest of them."""
HEIGHT = 230.0
TOP_SHARE = 0.99
"""Of the residuals lie within the scale of the colours; what is larger has its last colour."""
TITLES = {"before": "Before: declared physics, calibrated", "after": "After: with what was found"}
_HEAT = (224, 72, 47)  # on white and on black; its opacity is the value
_UNSEEN = (128, 128, 128, 46)


def carpets(found: Residuals) -> Html:
    """Length of the residual of every point in every frame, before and after in one scale; the pictures lie inside."""
    given = (
        {"Twin": found.before}
        if found.same
        else {TITLES["before"]: found.before, TITLES["after"]: found.after}
    )
    maps = {label: carpet(residual, found.order) for label, residual in given.items()}
    return residual_maps(maps, found.times, found.split_s)


def residual_maps(
    maps: Mapping[str, Array],
    times: Array,
    split_s: float | None,
    *,
    address: Callable[[str], str] | None = None,
    width: float = 540.0,
    narrow: float | None = None,
    grid: str = "two",
) -> Html:
    """Maps in one scale of colours, each with its figures in words, and a legend.

    Args:
        maps: lengths of the residual by label, (N, T) [m], NaN where a point was not seen.
        times: (T,) [s].
        split_s: when the held-out frames begin [s]; None: nothing is held out.
        address: where the picture of a label's map lies; None: in the page itself.
        width: of a map [px].
        narrow: of a second drawing for small windows [px]; None: without one.
        grid: class of what holds the maps.
    """
    top = scale_of(maps.values())
    figures = []
    for label, values in maps.items():
        place = address(label) if address else _data(map_png(values, times, top))
        figures.append(_figure(label, values, times, split_s, place, width, narrow))
    legend = tag(
        "div", tag("span", "0"), tag("i", class_="ramp"), tag("span", f"{number(MM * top)} mm"),
        tag("span", "not seen", class_="unseen"), class_="legend",
    )  # fmt: skip
    return tag("div", tag("div", *figures, class_=grid), legend)


def scale_of(maps: Iterable[Array]) -> float:
    """The residual that has the last colour in maps that are shown together [m]."""
    finite = np.concatenate([values[np.isfinite(values)] for values in maps])
    return float(np.quantile(finite, TOP_SHARE)) if finite.size else 1.0


def map_png(values: Array, times: Array, top: float) -> bytes:
    """A map as a picture: frames across, uneven times as they are, points upwards.

    Args:
        values: lengths of the residual, (N, T) [m], NaN where not seen.
        times: (T,) [s].
        top: the residual that has the last colour [m].
    """
    points, frames = values.shape
    if points > MOST_ROWS:
        first = np.linspace(0, points, MOST_ROWS, endpoint=False).astype(int)
        values = np.fmax.reduceat(values, first, axis=0)
    evenly = np.linspace(times[0], times[-1], min(max(frames, 2), MOST_FRAMES))
    column = np.clip(np.searchsorted(times, evenly, side="right") - 1, 0, frames - 1)
    shown = values[::-1][:, column]
    seen = np.isfinite(shown)
    share = np.clip(np.where(seen, shown, 0.0) / (top or 1.0), 0.0, 1.0)
    rgba = np.zeros((*shown.shape, 4), np.uint8)
    rgba[..., :3] = _HEAT
    rgba[..., 3] = 255 * np.sqrt(share)
    rgba[~seen] = _UNSEEN
    return png(rgba)


def png(rgba: Array) -> bytes:
    """A picture (H, W, 4) uint8 as a file."""
    height, width, _ = rgba.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), rgba.reshape(height, -1)], axis=1)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def _data(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode()


def _figure(
    label: str,
    values: Array,
    times: Array,
    split_s: float | None,
    place: str,
    width: float,
    narrow: float | None,
) -> Html:
    title = f"{label}: residual over points and time"

    def drawn(across: float, ticks: int, kind: str) -> Html:
        ends = float(times[0]), float(times[-1])
        axes = Axes(across, HEIGHT, ends, (0.0, float(len(values))), ticks=ticks)
        foot = axes.height - axes.bottom
        parts: list[Child] = [
            tag("image", x=axes.left, y=axes.top, width=axes.width - axes.left - axes.right,
                height=foot - axes.top, preserveAspectRatio="none", class_="pixels", href=place),
            *(part for part in axes.grid("time [s]", "points along the body") if "grid" not in part[:20]),
        ]  # fmt: skip
        if split_s is not None:
            x = axes.x(split_s)
            parts.append(tag("line", class_="split", x1=x, x2=x, y1=axes.top, y2=foot))
        parts.append(tag("line", class_="playhead", x1=axes.left, x2=axes.left, y1=axes.top, y2=foot))
        return picture(
            axes.width, axes.height, title, *parts, kind=kind, data_time=f"{ends[0]:.6g} {ends[1]:.6g}",
            data_span=f"{axes.left:g} {axes.width - axes.right:g}",
        )  # fmt: skip

    return tag(
        "figure", tag("figcaption", tag("span", label), tag("span", _told(values, times))),
        scrolled(title, drawings(drawn, width, narrow)), class_="plot",
    )  # fmt: skip


def _told(values: Array, times: Array) -> str:
    """A map's figures in words."""
    if not np.isfinite(values).any():
        return "nothing was seen"
    worst = np.unravel_index(np.nanargmax(values), values.shape)
    return (
        f"median {number(MM * float(np.nanmedian(values)))} mm, "
        f"largest {number(MM * float(values[worst]))} mm at {number(float(times[worst[1]]))} s"
    )
