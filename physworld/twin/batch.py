"""Episodes of one twin side by side: other motions, other fields, other parameters, one run of the engine.

On a GPU a small body does not fill the device and many do; on a CPU the launches of a substep and the search for the
time step are shared. All episodes take the smallest of their time steps; the carriers are those of runs one by one at
that time step, to the order in which single-precision sums are added up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from physworld.arrays import Array
from physworld.engine.total.batch import Batch
from physworld.errors import BatchRefused, SimulationError
from physworld.twin.twin import Progress, Twin


@dataclass(frozen=True, eq=False)
class Episode:
    """One run of a twin; see :meth:`physworld.twin.twin.Twin.simulate_nodes`.

    Attributes:
        control_times, control_points: (Tc,) [s] and (Tc, K, 3) [m].
        frame_times: (T,) [s].
        properties: log factors of stiffness and density, (P, 2), or None.
        parameters: what :meth:`physworld.twin.twin.Twin.with_parameters` changes.
        from_rest: starts without the recording's initial velocity.
    """

    control_times: Array
    control_points: Array
    frame_times: Array
    properties: Array | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    from_rest: bool = False


@dataclass(frozen=True, eq=False)
class Outcome:
    """How an episode ended.

    Attributes:
        nodes: the carriers at its frames [m], (T, n, 3); None where it cannot be trusted.
        error: why it cannot; else None.
    """

    nodes: Array | None
    error: SimulationError | None

    def trusted(self) -> Array:
        """The carriers at the frames; raises the episode's error where there is one."""
        if self.error is not None:
            raise self.error
        assert self.nodes is not None
        return self.nodes


def simulate_batch(
    twin: Twin,
    episodes: Sequence[Episode],
    *,
    progress: Progress | None = None,
    time_step_s: float | None = None,
) -> list[Outcome]:
    """Integrate episodes of a twin side by side.

    Args:
        twin: what they have in common; its effects and contacts act on each of them.
        episodes: they stop at the same times, but may end earlier or later than others.
        progress: called with (frames done, frames in all); may raise to stop all.
        time_step_s: forced time step [s], or None for the smallest of the stable ones.

    Raises:
        BatchRefused: the twin is of the updated Lagrangian form or a mesh of triangles, or the episodes do not share
            their clock or what a law must share (:class:`physworld.engine.total.forces.ForcesSideBySide`).
        CFLViolation: the forced time step exceeds the stable limit of one of them.
    """
    if not twin.lattice.smooth:
        raise BatchRefused(f"{len(episodes)} episodes of {twin.lattice.title}: it is integrated alone")
    if not twin.form.supports("batches"):
        raise BatchRefused(
            f"{len(episodes)} episodes of the updated Lagrangian form: its bodies would meet on one grid"
        )
    changed = [twin.with_parameters(**episode.parameters) for episode in episodes]
    runs = [
        one.integration(
            episode.control_times,
            episode.control_points,
            episode.frame_times,
            properties=episode.properties,
            from_rest=episode.from_rest,
        )
        for one, episode in zip(changed, episodes, strict=True)
    ]
    start = twin.body.start
    ended = Batch([run.problem for run in runs], time_step_s).run(
        [start] * len(runs),
        [run.velocity for run in runs],
        [run.held for run in runs],
        [run.knots for run in runs],
        progress,
    )
    return [
        Outcome(None, nodes)
        if isinstance(nodes, SimulationError)
        else Outcome(run.at_frames(start, nodes), None)
        for run, nodes in zip(runs, ended, strict=True)
    ]
