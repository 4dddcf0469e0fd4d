"""Other people's models of deformable objects in their plainest form, to be fitted and scored beside a twin.

Every peer is a function that fits a model to the training frames of a scene and nothing else, and returns what
predicts the tracked points (T, N, 3) [m] of any recording of such an object from its first frame and its controllers.
One that has no word for an object raises :class:`physworld.errors.SceneUnsupported`. They are written from the cited
publications, not from the authors' code, and have none of their learned parts.
"""

from __future__ import annotations

from collections.abc import Callable

from physworld.arrays import Array
from physworld.baselines.elastic_rod import fit_elastic_rod
from physworld.baselines.linear_cloth import fit_linear_cloth
from physworld.baselines.phystwin import fit_phystwin
from physworld.baselines.rigid_links import fit_rigid_links
from physworld.baselines.spring_gaus import fit_spring_gaus
from physworld.scene import Scene

PEERS: dict[str, Callable[[Scene], Callable[[Scene], Array]]] = {
    "elastic_rod": fit_elastic_rod,
    "rigid_links": fit_rigid_links,
    "linear_cloth": fit_linear_cloth,
    "phystwin": fit_phystwin,
    "spring_gaus": fit_spring_gaus,
}

__all__ = [
    "PEERS",
    "fit_elastic_rod",
    "fit_linear_cloth",
    "fit_phystwin",
    "fit_rigid_links",
    "fit_spring_gaus",
]
