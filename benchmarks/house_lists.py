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
    "torch, edge by edge, as an oracle": (("physworld/worldmodel/naive.py", "def forward("),),
    "torch.export and ONNX": (("physworld/worldmodel/export.py", "class StepProgram"),),
    "native rollouts": (
        ("physworld/worldmodel/engine_kernels.py", "def rollout("),
        ("physworld/worldmodel/native/engine_kernels.py", "def rollout("),
    ),
    "numpy, in the client": (("clients/python/physworld_client/network.py", "def step("),),
}
"""A copy of the step, and where it is or was: (file, text that it holds)."""

_EXPORTS = "clients/python/physworld_client/export"
ADDITIONS = {
    "an effect": (
        ("physworld/effects/NEW.py", "physworld/effects/registry.py"),
        (
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
        ("physworld/materials/NEW.py", "physworld/materials/library.py"),
        (
            "physworld/materials/NEW.py",
            "physworld/materials/library.py",
            "physworld/calibrate/parameters.py",
            "physworld/calibrate/law_choice.py",
            "schemas/fit.py",
            "services/api/routes/library.py",
        ),
    ),
    "an importer": (
        ("scenes/importers/NEW.py", "scenes/importers/__init__.py"),
        (
            "storage/importers/NEW.py",
            "storage/importers/__init__.py",
            "clients/python/physworld_client/bundle.py",
        ),
    ),
    "a metric": (
        ("physworld/evaluate/metrics.py",),
        (
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
        (f"{_EXPORTS}/NEW.py", f"{_EXPORTS}/__init__.py"),
        (
            f"{_EXPORTS}/NEW.py",
            f"{_EXPORTS}/__init__.py",
            "clients/python/physworld_client/cli/export.py",
        ),
    ),
    "a read-only route": (
        ("schemas/NEW.py", "services/api/routes/NEW.py"),
        ("schemas/NEW.py", "services/api/routes/NEW.py", "services/api/app.py"),
    ),
    "a job kind": (
        ("schemas/NEW.py", "schemas/job.py", "storage/jobs/kinds/NEW.py", "workers/tasks/NEW.py"),
        (
            "schemas/NEW.py",
            "schemas/job.py",
            "schemas/queues.py",
            "storage/opening.py",
            "storage/flow.py",
            "storage/results.py",
            "storage/retries.py",
            "workers/tasks/NEW.py",
            "workers/tasks/__init__.py",
        ),
    ),
}
"""Files that each kind of addition touches by hand, beside tests and docs: now, and before the rooms were rebuilt.

The lists of before are the files that named a member of the kind (``git grep`` for one effect, one law and so on), less
what only uses it; those of now are what ``CONTRIBUTING.md`` says. What ``make catalogue`` writes is not counted.
"""
