# Made of async_videos.py by `make sdk`: change that file.
"""Films of motions, drawn by the service, and the pictures beside a scene that they show and are compared with."""

from __future__ import annotations

from pathlib import Path

from physworld_client.base import Listed
from physworld_client.bundle import picture_at
from physworld_client.calls import Call, route
from physworld_client.pages import ListPage
from physworld_client.types import Job, Scene, Video
from physworld_schemas.video import FILM, FilmName, VideoConfig, VideoCreate, VideoOf


class Videos(Listed):
    """Films: of a scene's recording, a fit's twin, a model's prediction of its recording, a rollout."""

    resource = "videos"

    def create(self, of: VideoOf, id: str, config: VideoConfig | None = None) -> Job:
        """Starts a film; its job's output is the film.

        Args:
            of: "scene", "fit", "model" or "rollout".
            id: of that; of a model "name", "name:3" or "name:alias".
            config: camera, size and what is drawn; by default the scene's own camera and splat, where it has them.
        """
        body = VideoCreate(of=of, id=self._source(of, id), config=config or VideoConfig())
        return self._send("POST", Job, "videos", body=body)

    def get(self, video_id: str) -> Video:
        """One film: what was drawn, and its scores against the scene's pictures."""
        return self._send("GET", Video, "videos", self.id_of(video_id))

    def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        scene_id: str | None = None,
        of: VideoOf | None = None,
        source_id: str | None = None,
    ) -> ListPage[Video]:
        """Films, newest first.

        Args:
            limit: most films of a page; None leaves it to the service.
            cursor: of the page before.
            scene_id: only films that belong to this scene.
            of: only films of this kind of object.
            source_id: only films of this object; with ``of``, as in ``create``.
        """
        scene = None if scene_id is None else self._client.scenes.id_of(scene_id)
        source = source_id if source_id is None or of is None else self._source(of, source_id)
        return self._page(
            Video, "videos", cursor=cursor, limit=limit, scene_id=scene, of=of, source_id=source
        )

    def download(self, video_id: str, path: str | Path, name: FilmName = FILM) -> Path:
        """The film as an MP4 file at ``path``.

        Args:
            video_id: of the film.
            path: of the file to write.
            name: "film.mp4", or "recording.mp4": the scene's own pictures, where the film is compared with them.

        Raises:
            ValueError: there is none yet, or no recording beside it, with the reason.
        """
        video = self.get(video_id)
        film = next((item for item in video.artifacts if item.name == name), None)
        if film is None and video.report is not None:
            raise ValueError(
                f"video {video_id} has no {name}: {video.report.not_scored or 'it was drawn before'}"
            )
        if film is None:
            raise ValueError(f"video {video_id} is {video.state}: there is no film yet")
        return self._client.artifacts.download(film, path)

    def put_picture(self, scene_id: str, path: str | Path) -> Scene:
        """Keeps a file beside a scene for its films, in the place of one of the same kind.

        Args:
            scene_id: of the scene.
            path: of a splat of the object in the first frame (``.ply``), of the camera of the pictures (``.json``), or
                of the pictures (``.npz`` with ``frames`` (T, H, W, 3) uint8 and perhaps ``masks`` (T, H, W)).

        Raises:
            BundleUnreadable: nothing is there, or a file of another kind.
        """
        scene = self._client.scenes.id_of(scene_id)
        name, upload = picture_at(path)
        with upload, self._client.bars.sending(upload) as sent:
            call = Call("POST", route("scenes", scene, "pictures", name), Scene, upload=sent)
            return self._client.send(call)

    def _source(self, of: VideoOf, given: str) -> str:
        """The id of what a film is of; a model's name, with or without a version, is taken as it is."""
        sources: dict[str, Listed] = {
            "scene": self._client.scenes,
            "fit": self._client.fits,
            "rollout": self._client.rollouts,
        }
        return sources[of].id_of(given) if of in sources else given
