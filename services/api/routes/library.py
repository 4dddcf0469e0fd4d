"""The catalogue's lists: laws, effects, metrics, importers and export formats that this version knows."""

from __future__ import annotations

from fastapi import APIRouter

from physworld_schemas.base import FieldError, Page
from physworld_schemas.check import CheckConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.library import (
    Effect,
    ExportFormat,
    Importer,
    Material,
    Metric,
    NameKind,
    catalogue,
    known_names,
)
from physworld_schemas.trace import TraceConfig
from physworld_services.api.errors import ApiProblem, documented

router = APIRouter(tags=["library"], responses=documented(401, 403))
Named = tuple[tuple[str | int, ...], NameKind, str | None]
LISTS: dict[NameKind, str] = {
    "law": "GET /v1/materials",
    "flow law": "GET /v1/materials",
    "effect": "GET /v1/effects",
}


@router.get("/materials")
def list_materials() -> Page[Material]:
    """Constitutive laws of solids, sheets and rods, and flow laws of solids: `law` and `plasticity` of a fit."""
    return Page(data=catalogue().materials)


@router.get("/effects")
def list_effects() -> Page[Effect]:
    """Effects that a residual can be traced to, with their strengths' units and bounds."""
    return Page(data=catalogue().effects)


@router.get("/metrics")
def list_metrics() -> Page[Metric]:
    """Metrics of predictions on held-out frames, with units; comparisons show those that are `listed`."""
    return Page(data=catalogue().metrics)


@router.get("/importers")
def list_importers() -> Page[Importer]:
    """Forms of recordings that an upload may have."""
    return Page(data=catalogue().importers)


@router.get("/exports")
def list_exports() -> Page[ExportFormat]:
    """Forms in which the SDK and the command line write the episodes of a dataset."""
    return Page(data=catalogue().exports)


def require_known(**configs: FitConfig | TraceConfig | CheckConfig) -> None:
    """Refuse names that the catalogue does not have. Raises ApiProblem, 422, that names each.

    Args:
        configs: parts of a request's body by their key in it.
    """
    unknown = [
        FieldError(loc=["body", key, *place], msg=f"no {kind} {name!r}; {LISTS[kind]} lists them")
        for key, config in configs.items()
        for place, kind, name in _named(config)
        if name is not None and name not in known_names(kind)
    ]
    if unknown:
        raise ApiProblem(
            422, "invalid_request", "; ".join(fault.msg for fault in unknown[:3]), errors=unknown
        )


def _named(config: FitConfig | TraceConfig | CheckConfig) -> list[Named]:
    """Names in a configuration with their places."""
    if isinstance(config, FitConfig):
        return [(("law",), "law", config.law), (("plasticity",), "flow law", config.plasticity)]
    return [(("candidates", index), "effect", name) for index, name in enumerate(config.candidates)]
