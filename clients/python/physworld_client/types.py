"""The types of what the SDK takes and answers, and the type of arrays: everything to import from here.

Objects of the service have ``to_pandas()`` and mostly ``plot()`` (``physworld_client.objects``); settings and what
objects are made of are the wire's models. Shapes and units of arrays stand in docstrings, since numpy's types know
neither.
"""

from typing import Any, TypeAlias

import numpy.typing as npt

from physworld_client.objects import (
    ApiKey,
    Assessment,
    Check,
    Dataset,
    Episode,
    Event,
    Fit,
    Job,
    Loop,
    Model,
    ModelComparison,
    ModelVersion,
    Plan,
    Rollout,
    Scene,
    ScenePreview,
    SigningKey,
    Trace,
    Video,
)
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.assessment import ComparedVersion, ErrorFigure
from physworld_schemas.base import Artifact, FieldError, Lineage, Page, Problem, Reference
from physworld_schemas.check import (
    CheckConfig,
    CheckedEffect,
    CheckedGate,
    CheckedPair,
    CheckedParameter,
    CheckReport,
    CheckView,
    MotionChange,
    ProposedMotion,
)
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig, LocalStage, Numerics, Parameter, SearchState
from physworld_schemas.job import TERMINAL_STATES, Progress
from physworld_schemas.key import Role
from physworld_schemas.loop import LoopCreate, VersionError
from physworld_schemas.model import (
    ComparedError,
    Difference,
    ErrorCurves,
    MeasuredError,
    TrainingConfig,
)
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.plan import PlanConfig, PlanLimits, PointGoal, ShapeGoal
from physworld_schemas.rollout import Part, Start
from physworld_schemas.scene import ImportGuess, PreviewMarker, SceneImport
from physworld_schemas.trace import Figure, FoundEffect, TraceConfig
from physworld_schemas.tracking import (
    FilmPlane,
    FirstCloud,
    FirstPicture,
    Gripper,
    TrackingOptions,
    TrackingPreview,
)
from physworld_schemas.video import CameraView, VideoConfig, VideoReport, VideoScores

Array: TypeAlias = npt.NDArray[Any]
"""An array of any element type."""

__all__ = [
    "TERMINAL_STATES",
    "ApiKey",
    "Array",
    "Artifact",
    "Assessment",
    "CameraView",
    "Check",
    "CheckConfig",
    "CheckReport",
    "CheckView",
    "CheckedEffect",
    "CheckedGate",
    "CheckedPair",
    "CheckedParameter",
    "ComparedError",
    "ComparedVersion",
    "Dataset",
    "DatasetConfig",
    "Difference",
    "EncodedArray",
    "Episode",
    "ErrorCurves",
    "ErrorFigure",
    "Event",
    "FieldError",
    "Figure",
    "FilmPlane",
    "FirstCloud",
    "FirstPicture",
    "Fit",
    "FitConfig",
    "FoundEffect",
    "Gripper",
    "ImportGuess",
    "Job",
    "Lineage",
    "LocalStage",
    "Loop",
    "LoopCreate",
    "MeasuredError",
    "Model",
    "ModelComparison",
    "ModelVersion",
    "MotionChange",
    "Numerics",
    "Page",
    "Parameter",
    "Part",
    "PipelineCreate",
    "Plan",
    "PlanConfig",
    "PlanLimits",
    "PointGoal",
    "PreviewMarker",
    "Problem",
    "Progress",
    "ProposedMotion",
    "Reference",
    "Role",
    "Rollout",
    "Scene",
    "SceneImport",
    "ScenePreview",
    "SearchState",
    "ShapeGoal",
    "SigningKey",
    "Start",
    "Trace",
    "TraceConfig",
    "TrackingOptions",
    "TrackingPreview",
    "TrainingConfig",
    "VersionError",
    "Video",
    "VideoConfig",
    "VideoReport",
    "VideoScores",
]
