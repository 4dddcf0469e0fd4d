"""The order of a pipeline's child jobs.

::

    fit -> dataset -> training                                           without a trace
    fit -> trace -> dataset -> training                                  ``close_the_loop``, nothing added
    fit -> trace -> dataset -> training -> dataset -> training           ... an effect added: first on the fit's own
                                                                         twin, for comparison, then with the effect

A training whose ``start_share`` is below 1 is opened as soon as its dataset is planned, and runs beside it.

The comparison is left out when it was not asked for (``compare``) or when a ready version of the same name on an equal
twin with the same settings is there already.
"""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from schemas.job import TERMINAL_STATES, Progress
from schemas.model import TrainingCreate
from schemas.pipeline import PipelineCreate
from schemas.trace import TRACE_PARTICLES
from storage.opening import open_dataset, open_trace, open_training
from storage.registry import find_baseline
from storage.tables import JobRow, TraceRow
from storage.traces import leaves_twin, trace_row

_SHARES = {"fit": 0.35, "trace": 0.6, "dataset": 0.35, "training": 0.30}  # of a pipeline's time, about


def open_next(session: Session, parent: JobRow, ended: JobRow, children: Sequence[JobRow]) -> bool:
    """Open what follows the child that has just ended, when all have succeeded; False when nothing does.

    Times say nothing of what followed what: children are made by several hosts, whose clocks may differ and be set.
    """
    if any(job.state not in TERMINAL_STATES for job in children):
        return True  # a training runs beside its dataset; the end of the later one decides
    request = PipelineCreate.model_validate(parent.config)
    outputs = {job.kind: str(job.outputs[0]["id"]) for job in (*children, ended)}
    last = ended.kind
    if last == "dataset" and _has_training(children, outputs["dataset"]):
        last = "training"  # it ran beside its dataset and ended first
    if last == "fit" and request.close_the_loop:
        particles = min(request.fit.particle_budget, TRACE_PARTICLES)
        declared = request.fit.model_copy(update={"damping": "none", "particle_budget": particles})
        open_trace(session, request.scene_id, declared, request.trace, outputs["fit"], parent=parent)
    elif last == "dataset":
        name = request.model_name or ""
        training = TrainingCreate(name=name, dataset_id=outputs["dataset"], config=request.training)
        open_training(session, training, parent=parent)
    elif last == "training" and not _is_comparison(session, children):
        return False
    else:
        trace = trace_row(session, outputs["trace"]) if "trace" in outputs else None
        own = last == "trace" and trace is not None and _wants_comparison(session, request, trace, outputs)
        trace_id = None if trace is None or own else trace.id
        open_dataset(session, outputs["fit"], request.dataset, trace_id, parent=parent)
    return True


def dataset_planned(session: Session, parent: JobRow, dataset_id: str) -> None:
    """Open the training beside the dataset whose episodes are about to be made, where it need not wait for them."""
    request = PipelineCreate.model_validate(parent.config)
    if request.training.start_share < 1.0:
        name = request.model_name or ""
        training = TrainingCreate(name=name, dataset_id=dataset_id, config=request.training)
        open_training(session, training, parent=parent)


def share_done(parent: JobRow, children: Sequence[JobRow]) -> float:
    """How much of the pipeline is done, 0 to 1; a comparison counts until it is known to be left out."""
    request = PipelineCreate.model_validate(parent.config)
    kinds = ["fit", "dataset", "training"]
    if request.close_the_loop:
        kinds.append("trace")
        if request.compare:
            kinds += ["dataset", "training"]
    done = sum(_SHARES[child.kind] * _fraction(child) for child in children)
    return float(min(1.0, done / sum(_SHARES[kind] for kind in kinds)))


def _wants_comparison(
    session: Session, request: PipelineCreate, trace: TraceRow, outputs: dict[str, str]
) -> bool:
    if not request.compare or not leaves_twin(trace):
        return False
    dataset = request.dataset.model_dump(mode="json")
    name = request.model_name or ""
    return find_baseline(session, name, outputs["fit"], dataset, request.training) is None


def _has_training(children: Sequence[JobRow], dataset_id: str) -> bool:
    """Whether one of the jobs is a training on this dataset."""
    return any(job.kind == "training" and job.inputs[0]["id"] == dataset_id for job in children)


def _is_comparison(session: Session, children: Sequence[JobRow]) -> bool:
    """Whether the training that has just ended was the one without the effects that the trace added."""
    kinds = [job.kind for job in children]
    if "trace" not in kinds or kinds.count("training") > 1:
        return False
    trace = trace_row(session, str(children[kinds.index("trace")].outputs[0]["id"]))
    last_dataset = next(job for job in reversed(children) if job.kind == "dataset")
    return leaves_twin(trace) and all(item["kind"] != "trace" for item in last_dataset.inputs)


def _fraction(job: JobRow) -> float:
    if job.state == "succeeded":
        return 1.0
    progress = Progress.model_validate(job.progress)
    return min(1.0, max(0.0, progress.done / progress.total)) if progress.total > 0 else 0.0
