"""Errors of the world model.

WorldModelError
├── GraphInvalid         too few particles or controllers for a graph, shapes that disagree
├── DatasetUnusable      episodes too short, at another clock, or not numbers
├── TrainingDiverged     loss or gradient exploded several times in a row (``step`` says from when)
├── TrainingCancelled    the caller's ``cancelled`` said so
├── CheckpointMismatch   a checkpoint of other settings or other data
├── NetworkMismatch      a network that another one cannot go on from: other widths, or it hears of more
├── VersionUnreadable    a published version that this one cannot read: an older or newer layout
└── ControlsInvalid      control paths that cannot drive this model (``field`` says which part of them)
"""

from __future__ import annotations


class WorldModelError(Exception):
    """Base of this package's errors; the message carries the numbers that broke."""


class GraphInvalid(WorldModelError):
    """The particles and controllers make no graph."""


class DatasetUnusable(WorldModelError):
    """The episodes cannot train this model."""


class TrainingDiverged(WorldModelError):
    """From ``step`` on loss or gradient were no numbers, or exploded, several times in a row."""

    def __init__(self, step: int, loss: float) -> None:
        super().__init__(f"training diverged at step {step}: loss {loss}")
        self.step = step
        self.loss = loss


class TrainingCancelled(WorldModelError):
    """The caller asked to stop at ``step``."""

    def __init__(self, step: int) -> None:
        super().__init__(f"training cancelled at step {step}")
        self.step = step


class CheckpointMismatch(WorldModelError):
    """The checkpoint belongs to other settings or other data."""


class NetworkMismatch(WorldModelError):
    """Another network cannot go on from this one's weights."""


class VersionUnreadable(WorldModelError):
    """The tensors or facts of a published version are not of a layout that is read here."""

    code = "model_unreadable"


class ControlsInvalid(WorldModelError):
    """``field`` of a request for a rollout does not fit the model."""

    def __init__(self, message: str, field: str) -> None:
        super().__init__(message)
        self.field = field
