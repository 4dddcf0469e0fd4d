"""What ``benchmarks.house`` cannot count by itself: copies of the network's step, and the files of an addition.

Both name the files of a layout of the tree; a layout that is no longer there is skipped, one that is half there is
refused, so that a list cannot grow stale unseen.
"""

from __future__ import annotations

STEPS = {
    "training, torch, in the split form": (
        ("physworld/worldmodel/model.py", "def step("),
        ("physworld/worldmodel/model/model.py", "def step("),
    ),
    "torch, edge by edge, as an oracle": (
        ("physworld/worldmodel/naive.py", "def forward("),
        ("physworld/worldmodel/model/naive.py", "def forward("),
    ),
    "torch.export and ONNX": (
        ("physworld/worldmodel/export.py", "class StepProgram"),
        ("physworld/worldmodel/model/export.py", "class StepProgram"),
    ),
    "native rollouts": (
        ("physworld/worldmodel/engine_kernels.py", "def rollout("),
        ("physworld/worldmodel/native/engine_kernels.py", "def rollout("),
    ),
    "numpy, in the client": (("clients/python/physworld_client/network.py", "def step("),),
}
"""A copy of the step, and where it is or was: (file, text that it holds)."""

MOVED = (
    ("physworld/trace/", "physworld/trace/"),
    ("storage/jobs/", "storage/"),
    ("scenes/importers/", "storage/importers/"),
    ("scenes/comparison.py", "storage/comparison.py"),
)
"""Folders of the layout between the move of the rooms and their rebuilding, and the folders that they were before."""


def _moved(*paths: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A layout as it was after the move alone, and as it was before it."""
    before = paths
    for now, once in MOVED:
        before = tuple(path.replace(now, once) for path in before)
    return paths, before


ADDITIONS = {
    "an effect": (
        ("?schemas/catalogue.json", "physworld/effects/NEW.py", "physworld/effects/registry.py"),
        *_moved(
            "physworld/effects/NEW.py",
            "physworld/effects/registry.py",
            "services/api/effects.json",
            "physworld/trace/candidates.py",
            "physworld/trace/experiment.py",
            "physworld/trace/verdict.py",
            "physworld/trace/valleys.py",
            "physworld/trace/compound.py",
            "physworld/trace/unknowns.py",
        ),
    ),
    "a law of solids": (
        ("?schemas/catalogue.json", "physworld/materials/NEW.py", "physworld/materials/library.py"),
        *_moved(
            "physworld/materials/NEW.py",
            "physworld/materials/library.py",
            "physworld/calibrate/parameters.py",
            "physworld/calibrate/law_choice.py",
            "schemas/fit.py",
            "services/api/routes/library.py",
        ),
    ),
    "an importer": (
        ("?schemas/catalogue.json", "scenes/importers/NEW.py", "scenes/importers/__init__.py"),
        *_moved(
            "scenes/importers/NEW.py",
            "scenes/importers/__init__.py",
            "clients/python/physworld_client/bundle.py",
        ),
    ),
    "a metric": (
        ("?schemas/catalogue.json", "physworld/evaluate/metrics.py"),
        *_moved(
            "physworld/evaluate/metrics.py",
            "physworld/evaluate/table.py",
            "storage/comparison.py",
            "services/trainer/measuring.py",
            "services/dashboard/tables.py",
            "services/dashboard/templates/macros.html",
            "schemas/pipeline.py",
            "clients/python/physworld_client/cli/report.py",
        ),
    ),
    "an export format": (
        (
            "?schemas/catalogue.json",
            "clients/python/physworld_client/export/NEW.py",
            "clients/python/physworld_client/export/__init__.py",
        ),
        *_moved(
            "clients/python/physworld_client/export/NEW.py",
            "clients/python/physworld_client/export/__init__.py",
            "clients/python/physworld_client/cli/export.py",
        ),
    ),
    "a read-only route": (
        ("?schemas/catalogue.json", "schemas/NEW.py", "services/api/routes/NEW.py"),
        *_moved("schemas/NEW.py", "services/api/routes/NEW.py", "services/api/app.py"),
    ),
    "a job kind": (
        *_moved(
            "schemas/NEW.py",
            "schemas/job.py",
            "schemas/queues.py",
            "storage/jobs/opening.py",
            "storage/jobs/flow.py",
            "storage/jobs/results.py",
            "storage/jobs/retries.py",
            "workers/tasks/NEW.py",
            "workers/tasks/__init__.py",
        ),
    ),
}
"""Files that each kind of addition touches, layouts of the tree from the newest to the oldest.

A file behind a question mark only tells the layout: ``schemas/catalogue.json`` is written by ``make catalogue``, with
the tables in the docs.

The lists of the old layouts are the files that named a member of the kind (``git grep`` for one effect, one law and so
on), less what only uses it.
"""
