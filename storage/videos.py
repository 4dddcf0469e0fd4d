"""Films: rows in, wire models out; born pending, filled in by the commit of their shard. And a scene's pictures."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Artifact, Lineage, Page, Unmade
from physworld_schemas.scene import Scene
from physworld_schemas.video import Video, VideoReport
from physworld_storage import resources
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.pages import page_of
from physworld_storage.tables import SceneRow, VideoRow, columns_of


def get_video(session: Session, video_id: str) -> Video:
    """The film, or NotFound."""
    return _video(video_row(session, video_id))


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
    statement = select(VideoRow)
    wanted = ((VideoRow.scene_id, scene_id), (VideoRow.of, of), (VideoRow.source_id, source_id))
    for column, value in wanted:
        if value is not None:
            statement = statement.where(column == value)
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
    row = video_row(session, video_id)
    if row.state != "pending":
        raise Conflict(f"video {video_id} is {row.state}; only a pending one can become ready")
    row.state = "ready"
    row.report = report.model_dump(mode="json")
    row.artifacts = [artifact.model_dump(mode="json") for artifact in artifacts]
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def end_video(session: Session, video_id: str, state: Unmade) -> None:
    """Mark a pending film failed or cancelled; a ready one stays as it is."""
    row = video_row(session, video_id)
    if row.state == "pending":
        row.state = state


def video_row(session: Session, video_id: str) -> VideoRow:
    """The row, or NotFound."""
    row = session.get(VideoRow, video_id)
    if row is None:
        raise NotFound("video", video_id)
    return row


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
