"""From a residual to a named effect: see :func:`physworld.trace.run.trace`."""

from physworld.estimation.simulations import Memory, TimeUp, Workers
from physworld.trace.config import TraceConfig
from physworld.trace.report import document
from physworld.trace.result import Named, Number, TraceResult
from physworld.trace.run import trace

__all__ = [
    "Memory",
    "Named",
    "Number",
    "TimeUp",
    "TraceConfig",
    "TraceResult",
    "Workers",
    "document",
    "trace",
]
