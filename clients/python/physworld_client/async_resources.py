"""The service's resources. Every answer is a model of ``physworld_schemas``."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path

import httpx

from physworld_client import transport
from physworld_client.arrays import arrays_of
from physworld_client.async_base import AsyncListed, AsyncResource
from physworld_client.bundle import open_bundle, open_pictures
from physworld_client.calls import Call, given, page_of, route
from physworld_client.errors import PhysWorldError, WaitTimedOut
from physworld_client.export import open_export
from physworld_client.known_keys import is_fingerprint, trusted_keys
from physworld_client.manifest import artifacts_of, verify_folder
from physworld_client.pages import AsyncListPage
from physworld_client.signatures import given_key
from physworld_client.stream import HEARTBEAT_S, IDLE_LIMIT_S, EventDecoder, ends_job
from physworld_client.types import (
    Array,
    Dataset,
    Episode,
    Event,
    Fit,
    Job,
    Model,
    ModelComparison,
    ModelVersion,
    Scene,
    ScenePreview,
    SigningKey,
)
from physworld_client.waiting import Patience, job_id_of, require_success
from physworld_schemas.dataset import DatasetConfig, DatasetCreate
from physworld_schemas.fit import FitConfig, FitCreate
from physworld_schemas.job import TERMINAL_STATES
from physworld_schemas.model import AliasSet, TrainingConfig, TrainingCreate, VersionPatch
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.scene import SceneImport, ScenePatch
from physworld_schemas.tracking import TrackingOptions, TrackingPreview

LATEST = "latest"


class AsyncScenes(AsyncListed):
    """Measured scenes."""

    resource = "scenes"

    async def create(self, path: str | Path, options: SceneImport | None = None) -> Scene:
        """Uploads a scene: a folder (packed to a zip), an archive, a ``final_data.pkl`` or a table of markers.

        Args:
            path: of the folder or file.
            options: what a foreign recording does not say of itself.
        """
        with open_bundle(path) as upload, self._client.bars.sending(upload) as sent:
            call = Call("POST", route("scenes"), Scene, upload=sent, form=_form(options))
            return await self._client.send(call)

    async def preview(self, path: str | Path, options: SceneImport | None = None) -> ScenePreview:
        """What an import of a recording would guess: axes, unit, rate, gripper, noise. Nothing is stored."""
        with open_bundle(path) as upload, self._client.bars.sending(upload) as sent:
            call = Call("POST", route("scenes", "preview"), ScenePreview, upload=sent, form=_form(options))
            return await self._client.send(call)

    async def get(self, scene_id: str) -> Scene:
        """One scene."""
        return await self._send("GET", Scene, "scenes", await self.id_of(scene_id))

    async def update(self, scene_id: str, *, tags: tuple[str, ...]) -> Scene:
        """Gives a scene these tags, in the place of those before. The recording itself never changes."""
        body = ScenePatch(tags=[*tags])
        return await self._send("PATCH", Scene, "scenes", await self.id_of(scene_id), body=body)

    async def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        kind: str | None = None,
        tag: str | None = None,
    ) -> AsyncListPage[Scene]:
        """Scenes, newest first.

        Args:
            limit: items of a page.
            cursor: ``next_cursor`` of the page before; None: the first page.
            kind: only those of this kind.
            tag: only those with this tag.
        """
        return await self._page(Scene, "scenes", cursor=cursor, limit=limit, kind=kind, tag=tag)


def _form(options: SceneImport | TrackingOptions | None) -> dict[str, str]:
    """What stands beside an upload."""
    return {} if options is None else {"options": options.model_dump_json(exclude_unset=True)}


class AsyncTrackings(AsyncResource):
    """Pictures of an object in motion, of which a job makes a scene."""

    async def create(
        self,
        path: str | Path,
        options: TrackingOptions | None = None,
        files: Mapping[str, Path] | None = None,
    ) -> Job:
        """Uploads pictures; the job's output is the scene.

        Args:
            path: folder of pictures (packed to a zip), archive of one, or film.
            options: where the object is, what moves it, what is known of it.
            files: further files by the names that the options give them: masks, tracks, a robot's log, a camera.
        """
        with open_pictures(path, files) as upload, self._client.bars.sending(upload) as sent:
            call = Call("POST", route("trackings"), Job, upload=sent, form=_form(options))
            return await self._client.send(call)

    async def preview(self, path: str | Path, options: TrackingOptions | None = None) -> TrackingPreview:
        """The first picture of each camera, in whose pixels the options speak, and its cloud in the scene's world.
        Nothing is stored; of the options the boxes, ``up`` and ``depth_scale`` bear on the cloud.
        """
        with open_pictures(path) as upload, self._client.bars.sending(upload) as sent:
            call = Call(
                "POST", route("trackings", "preview"), TrackingPreview, upload=sent, form=_form(options)
            )
            return await self._client.send(call)


class AsyncFits(AsyncListed):
    """Calibrated twins."""

    resource = "fits"

    async def create(
        self, scene_id: str, config: FitConfig | None = None, *, scene_ids: Sequence[str] = ()
    ) -> Job:
        """Starts a fit; its job's output is the fit. ``scene_ids``: further recordings of the object, fitted too."""
        scene = await self._client.scenes.id_of(scene_id)
        further = [await self._client.scenes.id_of(one) for one in scene_ids]
        body = FitCreate(scene_id=scene, scene_ids=further, config=config or FitConfig())
        return await self._send("POST", Job, "fits", body=body)

    async def get(self, fit_id: str) -> Fit:
        """One fit."""
        return await self._send("GET", Fit, "fits", await self.id_of(fit_id))

    async def list(
        self, *, limit: int | None = None, cursor: str | None = None, state: str | None = None
    ) -> AsyncListPage[Fit]:
        """Fits, newest first."""
        return await self._page(Fit, "fits", cursor=cursor, limit=limit, state=state)


class AsyncDatasets(AsyncListed):
    """Datasets of demonstration episodes."""

    resource = "datasets"

    async def create(
        self, fit_id: str, config: DatasetConfig | None = None, *, trace_id: str | None = None
    ) -> Job:
        """Starts writing a dataset, in the twin that the trace made where it added an effect."""
        fit = await self._client.fits.id_of(fit_id)
        trace = None if trace_id is None else await self._client.traces.id_of(trace_id)
        body = DatasetCreate(fit_id=fit, trace_id=trace, config=config or DatasetConfig())
        return await self._send("POST", Job, "datasets", body=body)

    async def get(self, dataset_id: str) -> Dataset:
        """One dataset."""
        return await self._send("GET", Dataset, "datasets", await self.id_of(dataset_id))

    async def list(
        self, *, limit: int | None = None, cursor: str | None = None, state: str | None = None
    ) -> AsyncListPage[Dataset]:
        """Datasets, newest first."""
        return await self._page(Dataset, "datasets", cursor=cursor, limit=limit, state=state)

    async def episodes(
        self, dataset_id: str, *, limit: int | None = None, cursor: str | None = None
    ) -> AsyncListPage[Episode]:
        """The committed episodes of a dataset."""
        dataset = await self.id_of(dataset_id)
        return await self._page(Episode, "datasets", dataset, "episodes", cursor=cursor, limit=limit)

    async def episode(self, dataset_id: str, index: int) -> dict[str, Array]:
        """The arrays of one committed episode.

        ``times`` (T,) [s], ``particles`` (T, P, 3) [m], ``controllers`` (T, K, 3) [m], ``properties`` (P, 2): log
        factors of stiffness and density, (P, 3) with the ground's friction where it was perturbed as a field;
        ``attributes``: JSON text.

        Raises:
            NotFound: no such episode is committed.
        """
        dataset = await self.id_of(dataset_id)
        return arrays_of(await self._send("GET", bytes, "datasets", dataset, "episodes", index))

    async def export(
        self,
        dataset_id: str,
        folder: str | Path,
        *,
        format: str = "npz",
        episodes: int | None = None,
        points: int | None = None,
        on_progress: Callable[[int, int], None] | None = None,
    ) -> Path:
        """Writes the episodes of a sealed dataset for other tools: see :mod:`physworld_client.export`.

        Args:
            folder: a new or empty folder.
            format: one of ``physworld_client.export.FORMATS``; ``lerobot`` needs the extra ``export``.
            episodes: only the first so many.
            points: at most so many particles a frame; None: all, of ``lerobot`` 256.
            on_progress: called with (episodes written, episodes in all).

        Raises:
            ExportRefused: the dataset is not sealed, the folder holds something, a package is missing.
        """
        dataset = await self.get(dataset_id)
        writer = open_export(format, folder, dataset, points)
        count = dataset.episodes_done if episodes is None else min(episodes, dataset.episodes_done)
        for index in range(count):
            writer.add(index, await self.episode(dataset.id, index))
            if on_progress is not None:
                on_progress(index + 1, count)
        writer.finish()
        return Path(folder)


class AsyncModels(AsyncListed):
    """Published world models: names, integer versions, aliases."""

    resource = "models"

    async def create(
        self,
        name: str,
        dataset_id: str,
        config: TrainingConfig | None = None,
        *,
        description: str = "",
        tags: tuple[str, ...] = (),
    ) -> Job:
        """Trains on a sealed dataset and publishes the next version of ``name``.

        Args:
            name: of the model.
            dataset_id: the dataset.
            config: settings of the training.
            description: of the version, for people.
            tags: of the version.
        """
        dataset = await self._client.datasets.id_of(dataset_id)
        body = TrainingCreate(
            name=name,
            dataset_id=dataset,
            config=config or TrainingConfig(),
            description=description,
            tags=[*tags],
        )
        return await self._send("POST", Job, "models", body=body)

    async def get(self, name: str) -> Model:
        """One registered name with its newest version and aliases."""
        return await self._send("GET", Model, "models", name)

    async def list(self, *, limit: int | None = None, cursor: str | None = None) -> AsyncListPage[Model]:
        """Registered names."""
        return await self._page(Model, "models", cursor=cursor, limit=limit)

    async def versions(
        self, name: str, *, limit: int | None = None, cursor: str | None = None
    ) -> AsyncListPage[ModelVersion]:
        """Versions of a name, newest first."""
        return await self._page(ModelVersion, "models", name, "versions", cursor=cursor, limit=limit)

    async def version(self, name: str, version: int | str = LATEST) -> ModelVersion:
        """One version: by its number, by an alias, or the newest that is ready."""
        return await self._send("GET", ModelVersion, "models", name, "versions", version)

    async def set_alias(self, name: str, alias: str, version: int) -> Model:
        """Moves an alias to a version."""
        body = AliasSet(version=version)
        return await self._send("PUT", Model, "models", name, "aliases", alias, body=body)

    async def delete_alias(self, name: str, alias: str) -> Model:
        """Removes an alias; the version stays."""
        return await self._send("DELETE", Model, "models", name, "aliases", alias)

    async def update(
        self,
        name: str,
        version: int | str,
        *,
        description: str | None = None,
        tags: tuple[str, ...] | None = None,
    ) -> ModelVersion:
        """Changes description and tags of a version; its files never change.

        Args:
            name: of the model.
            version: its number or an alias.
            description: the new one; None: as it is.
            tags: the new ones; None: as they are.
        """
        body = VersionPatch(description=description, tags=None if tags is None else [*tags])
        return await self._send("PATCH", ModelVersion, "models", name, "versions", version, body=body)

    async def compare(self, name: str, a: int | str, b: int | str) -> ModelComparison:
        """Two ready versions: errors with intervals and paired gains, curves, differences in how they were made."""
        asked = {"a": str(a), "b": str(b)}
        return await self._client.send(
            Call("GET", route("models", name, "compare"), ModelComparison, query=asked)
        )

    async def signing_keys(self) -> tuple[SigningKey, ...]:
        """Every public key that signs, or once signed, this service's models."""
        call = Call("GET", route("signing-keys"), page_of(SigningKey), query={"limit": 200})
        return tuple((await self._client.send(call)).data)

    async def trust(self, key: str | Path) -> str:
        """Trusts a key to sign this service's models, beside those that are; its fingerprint.

        Args:
            key: the fingerprint of a key that the service lists, a public key in base64, or the ``Path`` of a file
                that holds one of them.

        Raises:
            SignatureInvalid: the service lists no key with that fingerprint.
            ModelUnreadable: it is no key, or the file of known keys cannot be read or written.
        """
        given = given_key(key)
        listed = await self.signing_keys() if is_fingerprint(given) else ()
        return self._client.known_keys.trust(self._client.known_as, given, listed)

    async def distrust(self, fingerprint: str) -> None:
        """Trusts a key no more to sign this service's models. Raises ModelUnreadable when it was not trusted."""
        self._client.known_keys.distrust(self._client.known_as, fingerprint)

    async def download(
        self,
        name: str,
        folder: str | Path,
        version: int | str = LATEST,
        *,
        public_key: str | Path | None = None,
        trust: str | Path | None = None,
        allow_unsigned: bool = False,
    ) -> ModelVersion:
        """Downloads every file of a version into ``folder`` and verifies them: signature, manifest, digests.

        The first download from a service pins the keys that it lists; see ``physworld_client.known_keys``.

        Args:
            public_key: the only key that may have signed, in base64 or as the ``Path`` of a file; nothing is pinned.
            trust: a key to trust first, as in ``trust``.
            allow_unsigned: take a version that was published before there were signatures.

        Raises:
            SigningKeyUntrusted: another key signed than those that are trusted for this service.
            SignatureInvalid: the manifest is not signed, or was changed since.
            DigestMismatch: a file is not what the manifest promises.
            ModelUnreadable: the version is not ready or its artifacts are incomplete.
        """
        if trust is not None:
            await self.trust(trust)
        found = await self.version(name, version)
        target = Path(folder)
        for artifact in artifacts_of(found):
            await self._client.artifacts.download(artifact.sha256, target / artifact.name)
        if public_key is not None or allow_unsigned:
            verify_folder(target, found.sha256, keys=trusted_keys(public_key, allow_unsigned))
            return found
        keys = self._client.known_keys.expected(self._client.known_as, await self.signing_keys())
        verify_folder(target, found.sha256, keys=keys)
        self._client.known_keys.met(keys)
        return found


class AsyncPipelines(AsyncResource):
    """The whole chain in one call."""

    async def create(self, body: PipelineCreate | None = None, *, scene_id: str | None = None) -> Job:
        """Starts fit, dataset and training; from a full body, or with the defaults for a scene."""
        if (body is None) == (scene_id is None):
            raise TypeError("pipelines.create takes either a PipelineCreate or scene_id")
        asked = PipelineCreate(scene_id=str(scene_id)) if body is None else body
        scene = await self._client.scenes.id_of(asked.scene_id)
        further = [await self._client.scenes.id_of(one) for one in asked.scene_ids]
        named = asked.model_copy(update={"scene_id": scene, "scene_ids": further})
        return await self._send("POST", Job, "pipelines", body=named)


class AsyncJobs(AsyncListed):
    """Jobs: their state, events, cancellation, and the wait for their end."""

    resource = "jobs"

    async def get(self, job_id: str, *, wait_s: float | None = None) -> Job:
        """One job; with ``wait_s`` the answer comes at the job's end or after that many seconds."""
        path = route("jobs", await self.id_of(job_id))
        return await self._client.send(
            Call("GET", path, Job, query=given(wait=wait_s), read_timeout_s=wait_s or 0.0)
        )

    async def list(
        self,
        *,
        limit: int | None = None,
        cursor: str | None = None,
        state: str | None = None,
        kind: str | None = None,
    ) -> AsyncListPage[Job]:
        """Jobs, newest first.

        Args:
            limit: items of a page.
            cursor: ``next_cursor`` of the page before; None: the first page.
            state: only those in this state.
            kind: only those of this kind.
        """
        return await self._page(Job, "jobs", cursor=cursor, limit=limit, state=state, kind=kind)

    async def retry(self, job_id: str) -> Job:
        """Takes a failed job up again, with its pipeline: stored episodes, journals and checkpoints are kept."""
        return await self._send("POST", Job, "jobs", await self.id_of(job_id), "retry")

    async def cancel(self, job_id: str) -> Job:
        """Asks for the job's end; it is ``cancelling`` until its workers have let go."""
        return await self._send("POST", Job, "jobs", await self.id_of(job_id), "cancel")

    async def events(self, job_id: str, *, after: int | None = None) -> AsyncIterator[Event]:
        """The job's events, past and coming, until the one that ends the job.

        A broken stream is resumed after the last event seen; more than ``max_retries`` breaks without an
        event between them raise ``ConnectionFailed``.
        """
        job_id = await self.id_of(job_id)
        decoder = EventDecoder(after)
        retry = transport.Retry(self._client.max_retries)
        while True:
            seen = decoder.last_id
            broken: httpx.TransportError | None = None
            try:
                async for line in self._lines(job_id, decoder):
                    event = decoder.feed(line)
                    if event is not None:
                        yield event
                        if ends_job(event, job_id):
                            return
            except httpx.TransportError as error:
                broken = error
            if decoder.last_id != seen:
                retry.attempt = 0
            elif broken is None:
                job = await self.get(job_id)
                if job.state in TERMINAL_STATES:
                    return
            if not retry.again():
                raise transport.stream_ended(broken, self._client.http, retry) from broken
            decoder.reset()
            await asyncio.sleep(retry.delay_s())

    async def wait(
        self,
        job: Job | str,
        timeout: float | None = None,
        on_progress: Callable[[Job], None] | None = None,
    ) -> Job:
        """Waits for the job's end and returns it.

        Follows the event stream; where that is not to be had (a proxy that buffers it, a restart of the
        service), and near the end of the timeout, it long-polls.

        Args:
            timeout: seconds, None waits for ever.
            on_progress: called with the job whenever its state or progress has changed.

        Raises:
            JobFailed, JobCancelled: the job ended so.
            WaitTimedOut: the job goes on.
        """
        patience = Patience(timeout, on_progress)
        current = patience.see(await self.get(job_id_of(job)))
        if current.state not in TERMINAL_STATES and patience.left_s() > HEARTBEAT_S:
            with contextlib.suppress(httpx.TransportError, PhysWorldError):
                current = await self._follow(current, patience)
        while current.state not in TERMINAL_STATES:
            if patience.left_s() <= 0:
                raise WaitTimedOut(current, patience.timeout_s)
            current = patience.see(await self.get(current.id, wait_s=patience.poll_s()))
        return require_success(current)

    async def _follow(self, job: Job, patience: Patience) -> Job:
        """Follows the stream until the job ends, the stream does, or the patience is nearly out."""
        decoder = EventDecoder()
        async for line in self._lines(job.id, decoder):
            event = decoder.feed(line)
            if event is not None:
                if ends_job(event, job.id):
                    break
                if patience.wants_look():
                    job = patience.see(await self.get(job.id))
            if patience.left_s() <= HEARTBEAT_S:
                break
        return patience.see(await self.get(job.id))

    async def _lines(self, job_id: str, decoder: EventDecoder) -> AsyncIterator[str]:
        http = self._client.http
        timeout = httpx.Timeout(self._client.timeout, read=IDLE_LIMIT_S)
        path = route("jobs", job_id, "events")
        async with http.stream("GET", path, headers=decoder.headers(), timeout=timeout) as response:
            if response.status_code >= 400:
                await response.aread()
                transport.raise_for_problem(response)
            async for line in response.aiter_lines():
                yield line
