"""The catalogue's lists: laws, effects, metrics, importers and export formats that this version knows."""

from __future__ import annotations

from typing import Annotated, get_args, get_origin

from fastapi import APIRouter
from pydantic import BaseModel

from physworld_schemas.base import FieldError, Page
from physworld_schemas.library import Effect, ExportFormat, Importer, Material, Metric, NamesOf, catalogue
from physworld_services.api.errors import ApiProblem, documented

router = APIRouter(tags=["library"], responses=documented(401, 403))
ADDRESSES = {"elastic": "materials", "flow": "materials", "effects": "effects"}


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
