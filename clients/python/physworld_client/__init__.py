"""Python SDK of PhysWorld: the service's resources, typed, and the world model without the service.

    from physworld_client import Client

    with Client("http://127.0.0.1:8000", token="...") as client:
        scene = client.scenes.create("recordings/beam")
        job = client.jobs.wait(client.pipelines.create(scene_id=scene.id), on_progress=print)
        client.models.download(scene.name, "out/")

``physworld_client.world_model`` needs numpy and safetensors only. Neither torch nor warp is ever imported.
"""

from __future__ import annotations

from physworld_client.async_client import AsyncClient
from physworld_client.client import Client
from physworld_client.errors import (
    AmbiguousName,
    ApiError,
    AuthenticationFailed,
    BadRequest,
    BundleUnreadable,
    Conflict,
    ConnectionFailed,
    DigestMismatch,
    ExportRefused,
    ExtraMissing,
    InvalidRequest,
    JobCancelled,
    JobFailed,
    LiveSessionEnded,
    ModelUnreadable,
    NotFound,
    NothingToPlot,
    PayloadTooLarge,
    PermissionDenied,
    PhysWorldError,
    RateLimited,
    RequestTimedOut,
    SceneInvalid,
    ServerError,
    SignatureInvalid,
    SigningKeyUntrusted,
    UnknownName,
    WaitTimedOut,
)
from physworld_client.tables import to_pandas

__version__ = "0.2.0"

__all__ = [
    "AmbiguousName",
    "ApiError",
    "AsyncClient",
    "AuthenticationFailed",
    "BadRequest",
    "BundleUnreadable",
    "Client",
    "Conflict",
    "ConnectionFailed",
    "DigestMismatch",
    "ExportRefused",
    "ExtraMissing",
    "InvalidRequest",
    "JobCancelled",
    "JobFailed",
    "LiveSessionEnded",
    "ModelUnreadable",
    "NotFound",
    "NothingToPlot",
    "PayloadTooLarge",
    "PermissionDenied",
    "PhysWorldError",
    "RateLimited",
    "RequestTimedOut",
    "SceneInvalid",
    "ServerError",
    "SignatureInvalid",
    "SigningKeyUntrusted",
    "UnknownName",
    "WaitTimedOut",
    "__version__",
    "to_pandas",
]
