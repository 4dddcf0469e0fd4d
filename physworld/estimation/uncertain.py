"""What a prediction owes to things that were measured with noise and are not fitted: the pose of the start, and the way
of the controllers.

The way that a camera saw a gripper go errs slowly, by milliradians for whole seconds, and all of the body errs with it.
A scene may say by how much (``controller_errors``, independent changes of one standard deviation each). Each is
simulated once, and what it changes is taken out of residuals by its covariance
(:meth:`physworld.estimation.whitening.Whitener.knowing`), or makes intervals as wide as it would move a number.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.estimation.simulations import Drive, Job, Simulations
from physworld.estimation.whitening import turned_starts
from physworld.scene import Scene
from physworld.twin.twin import Twin


def mistaken_drives(scene: Scene) -> list[Drive]:
    """The scene's drive with each error of its controllers."""
    return [Drive(scene.times, controls, scene.times) for controls in scene.mistaken_controls()]


def doubtful(simulations: Simulations, scene: Scene, twin: Twin, tracks: Array, sigma: float) -> list[Array]:
    """Changes of the prediction, (frames, N, 3) [m], that are as likely as not: one standard deviation each.

    Args:
        simulations: of the scene.
        scene, twin: what is predicted.
        tracks: the prediction, (frames, N, 3).
        sigma: noise of the sightings [m].
    """
    frames = len(tracks)
    turned = simulations.run([Job(start, frames) for start in turned_starts(scene, twin, sigma)])
    driven = [simulations.under(drive, [Job(twin, frames)])[0] for drive in mistaken_drives(scene)]
    return [found - tracks for found in (*turned, *driven) if found is not None]


def moved_by(jacobian: Array, changes: list[Array]) -> Array:
    """Covariance (p, p) of numbers that least squares finds, of independent changes (m,) of what they are fitted to.

    Args:
        jacobian: (m, p).
        changes: one standard deviation each, (m,).
    """
    if not changes:
        return np.zeros((jacobian.shape[1],) * 2)
    shifts = np.linalg.lstsq(jacobian, np.stack(changes, axis=1), rcond=None)[0]
    covariance: Array = shifts @ shifts.T
    return covariance
