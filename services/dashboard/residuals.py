"""Per-frame residual maps of the pages: measured minus predicted, over the points of the body and the frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING
from urllib.parse import quote

from fastapi.responses import HTMLResponse, Response

from physworld.arrays import Array
from physworld.report.curves import along_body, carpet, measured_minus
from physworld.report.maps import map_png, residual_maps, scale_of
from physworld_services.dashboard.curves import NARROW_PX, split_time
from physworld_storage.errors import NotFound

if TYPE_CHECKING:
    from physworld.scene import Scene

WIDE_PX, BESIDE_PX = 980.0, 520.0
"""Width of a map that stands alone, and of one that stands beside another."""
KEPT = {"Cache-Control": "private, max-age=600"}


def maps_page(recording: Scene, predictions: Mapping[str, Array], url: str, query: str = "") -> HTMLResponse:
    """The maps of predictions as a part of a page.

    Args:
        recording: what was measured.
        predictions: tracks on the recording's time line by label, (T, N, 3) [m].
        url: of this part; the picture of a label's map lies below it.
        query: what addresses of pictures end with.
    """
    alone = len(predictions) == 1
    drawn = residual_maps(
        _maps(recording, predictions),
        recording.times,
        split_time(recording),
        address=lambda label: f"{url}/{quote(label)}.png{query}",
        width=WIDE_PX if alone else BESIDE_PX,
        narrow=NARROW_PX,
        grid="" if alone else "plots",
    )
    return HTMLResponse(drawn)


def map_picture(recording: Scene, predictions: Mapping[str, Array], label: str) -> Response:
    """The picture of one of the maps, in the scale of all of them. Raises NotFound."""
    maps = _maps(recording, predictions)
    if label not in maps:
        raise NotFound("map of residuals", label)
    content = map_png(maps[label], recording.times, scale_of(maps.values()))
    return Response(content, media_type="image/png", headers=KEPT)


def _maps(recording: Scene, predictions: Mapping[str, Array]) -> dict[str, Array]:
    order = along_body(recording)
    return {label: carpet(measured_minus(recording, tracks), order) for label, tracks in predictions.items()}
