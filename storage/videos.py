"""Films: rows in, wire models out; born pending, filled in by the commit of their shard. And a scene's pictures."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Artifact, Lineage, Page
from physworld_schemas.scene import Scene
from physworld_schemas.video import Video, VideoReport
from physworld_storage import resources
from physworld_storage.errors import NotFound
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, pending, plain, required
from physworld_storage.tables import SceneRow, VideoRow, columns_of


def get_video(session: Session, video_id: str) -> Video:
    """The film, or NotFound."""
    return _video(required(session, VideoRow, video_id))


def list_videos(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    scene_id: str | None = None,
    of: str | None = None,
    source_id: str | None = None,
) -> Page[Video]:
    """Films, newest first.

    Args:
        session: the transaction that reads.
        limit: most films of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        scene_id: only films that belong to this scene.
        of: only films of this kind of object.
        source_id: only films of this object.

    Raises:
        InvalidCursor: no list of films gave this cursor out.
    """
    filters = ((VideoRow.scene_id, scene_id), (VideoRow.of, of), (VideoRow.source_id, source_id))
    statement = chosen(select(VideoRow), *filters)
    return page_of(session, statement, (VideoRow.created_at, VideoRow.id), _video, limit=limit, cursor=cursor)


def mark_video_ready(
    session: Session, video_id: str, report: VideoReport, artifacts: list[Artifact], lineage: Lineage
) -> None:
    """Fill in a pending film.

    Args:
        session: the transaction that commits the shard.
        video_id: of a pending film.
        report: what was drawn.
        artifacts: the film.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such film.
        Conflict: it is not pending.
    """
    row = pending(session, VideoRow, video_id)
    row.state = "ready"
    row.report = report.model_dump(mode="json")
    row.artifacts = plain(artifacts)
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def put_picture(session: Session, scene_id: str, picture: Artifact) -> Scene:
    """Keep a file of pictures beside a scene, in the place of one of the same name. Raises NotFound."""
    row = session.get(SceneRow, scene_id, with_for_update=True)
    if row is None:
        raise NotFound("scene", scene_id)
    kept = [item for item in row.artifacts if item["name"] != picture.name]
    row.artifacts = [*kept, picture.model_dump(mode="json")]
    session.flush()
    return resources.get_scene(session, scene_id)


def _video(row: VideoRow) -> Video:
    return Video.model_validate(columns_of(row))
