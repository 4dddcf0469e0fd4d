"""The world model: a graph network that learns a twin's dynamics from demonstrations.

``clock`` and ``graph`` need numpy only; importing anything named below imports torch, so it happens on
first use.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "FineTuneConfig": "model.config",
    "FineTuneResult": "finetune",
    "GraphSpec": "model.graph",
    "PublishedModel": "published",
    "Recording": "finetune",
    "Skin": "model.skinning",
    "TrainingConfig": "model.config",
    "TrainingResult": "training",
    "WorldModel": "model.model",
    "WorldModelConfig": "model.config",
    "WorldModelError": "errors",
    "affine_skin": "model.skinning",
    "build_graph": "model.graph",
    "fine_tune": "finetune",
    "model_dt": "clock",
    "read_track": "dataset",
    "rollout": "rollout",
    "train": "training",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
