"""Colliders of a scene as the engine moves them: shapes from what is declared, paths from controllers or poses."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.terms.colliders import Collider
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.contact import ColliderContact, touching
from physworld.errors import SceneUnsupported
from physworld.geometry.rigid import rigid_motion
from physworld.scene import DeclaredCollider, Scene
from physworld.shapes import sdf
from physworld.shapes.surface_mesh import SurfaceMesh

_OVERLAP_SHARE = 0.5  # of a collider's own depth: material that starts deeper is on no side of it


@dataclass(frozen=True, eq=False)
class TwinCollider:
    """A declared collider, ready to move.

    Attributes:
        declared: what the scene says; its friction is a number.
        shape: signed distances in its own frame.
        times, poses: its track, (F,) [s] and (F, 7), position [m] and quaternion, scalar first; one pose if it stays or
            is carried by controllers.
    """

    declared: DeclaredCollider
    shape: sdf.Shape
    times: Array
    poses: Array

    def on_its_way(self, start: Array, times: Array, controllers: Array) -> Collider:
        """The collider under a control track.

        Args:
            start: controllers at the first frame, where its declared pose holds, (K, 3) [m].
            times, controllers: (Tc,) [s] and (Tc, K, 3) [m].
        """
        places, turns = self.poses[:, :3], _rotations(self.poses[:, 3:])
        knots = self.times
        if self.declared.controllers:
            group = list(self.declared.controllers)
            rotation, shift = rigid_motion(start[group], controllers[:, group])
            knots, places, turns = times, rotation @ places[0] + shift, rotation @ turns[0]
        path = RigidPath(knots, places, turns)
        return Collider(self.declared.name, self.shape, path, float(self.declared.friction or 0.0))

    def contact(
        self, collider: Collider, lattice: Lattice, nodes: Array, start_s: float, offset_m: float
    ) -> Any:
        """The term between this collider and a body.

        Args:
            collider: this one on its way, as :meth:`on_its_way` gives it.
            lattice: the body's.
            nodes: nodal positions of the body at its start [m], (n, 3).
            start_s: when the body is let go [s].
            offset_m: of a body that just touches, half the thickness of a sheet [m].

        Raises:
            SceneUnsupported: the body starts deep inside the collider.
        """
        offsets = touching(lattice, nodes, collider, start_s, offset_m)
        deepest = -float(offsets.min(initial=0.0))
        if deepest > _OVERLAP_SHARE * self.shape.inner_m:
            raise SceneUnsupported(
                f"the body starts {deepest:.3g} m inside of collider {self.declared.name!r}, which is "
                f"{2 * self.shape.inner_m:.3g} m thick: their poses do not agree"
            )
        return ColliderContact(collider, offsets)


def twin_colliders(scene: Scene, margin_m: float, friction: float) -> tuple[TwinCollider, ...]:
    """Colliders of a scene.

    Args:
        scene: the recording.
        margin_m: how far outside of a mesh distances are wanted [m].
        friction: where none is declared.

    Raises:
        SceneUnsupported: a shape without volume, a mesh that is not closed, a track without poses.
    """
    return tuple(_twin_collider(scene, declared, margin_m, friction) for declared in scene.colliders)


def carried(scene: Scene) -> Array:
    """Controllers that carry colliders and so grip nothing, ascending."""
    return np.array(sorted({i for collider in scene.colliders for i in collider.controllers}), dtype=int)


def to_parts(colliders: tuple[TwinCollider, ...]) -> tuple[list[dict[str, Any]], dict[str, Array]]:
    """Facts fit for JSON and arrays fit for an npz; :func:`from_parts` is the inverse."""
    facts: list[dict[str, Any]] = []
    arrays: dict[str, Array] = {}
    for number, collider in enumerate(colliders):
        declared = collider.declared
        plain = asdict(replace(declared, mesh=None))
        for key in ("size_m", "position_m", "quaternion_wxyz"):
            plain[key] = None if plain[key] is None else np.asarray(plain[key], dtype=float).tolist()
        facts.append(plain)
        arrays |= {f"collider_{number}_times": collider.times, f"collider_{number}_poses": collider.poses}
        if declared.mesh is not None:
            arrays |= {
                f"collider_{number}_vertices": declared.mesh.vertices,
                f"collider_{number}_faces": declared.mesh.faces,
            }
    return facts, arrays


def from_parts(
    facts: list[dict[str, Any]], arrays: dict[str, Array], margin_m: float
) -> tuple[TwinCollider, ...]:
    """The colliders that :func:`to_parts` took apart."""
    colliders = []
    for number, plain in enumerate(facts):
        mesh = None
        if plain["shape"] == "mesh":
            mesh = SurfaceMesh(arrays[f"collider_{number}_vertices"], arrays[f"collider_{number}_faces"])
        vectors = {
            key: None if plain[key] is None else np.array(plain[key], dtype=float)
            for key in ("size_m", "position_m", "quaternion_wxyz")
        }
        declared = DeclaredCollider(
            **{**plain, **vectors, "controllers": tuple(plain["controllers"]), "mesh": mesh}
        )
        track = arrays[f"collider_{number}_times"], arrays[f"collider_{number}_poses"]
        colliders.append(TwinCollider(declared, _shape(declared, margin_m), *track))
    return tuple(colliders)


def _twin_collider(
    scene: Scene, declared: DeclaredCollider, margin_m: float, friction: float
) -> TwinCollider:
    known = replace(declared, friction=friction if declared.friction is None else declared.friction)
    shape = _shape(known, margin_m)
    if declared.poses is None:
        pose = np.concatenate([declared.position_m, declared.quaternion_wxyz])[None]
        return TwinCollider(known, shape, np.zeros(1), pose)
    poses = scene.extra_arrays.get(declared.poses)
    if poses is None or poses.ndim != 2 or poses.shape[1] != 7:
        found = "no such array" if poses is None else f"shape {poses.shape}"
        raise SceneUnsupported(
            f"the poses {declared.poses!r} of collider {declared.name!r}: {found}, not (T, 7)"
        )
    control_times = scene.times if scene.control_times is None else scene.control_times
    times = scene.times if len(poses) == len(scene.times) else control_times
    if len(poses) != len(times):
        raise SceneUnsupported(
            f"{len(poses)} poses of collider {declared.name!r} for {len(scene.times)} frames and {len(times)} samples"
        )
    return TwinCollider(known, shape, times, np.asarray(poses, dtype=float))


def _shape(declared: DeclaredCollider, margin_m: float) -> sdf.Shape:
    radius, length = declared.radius_m or 0.0, declared.length_m or 0.0
    if declared.shape == "mesh":
        if declared.mesh is None:
            raise SceneUnsupported(f"collider {declared.name!r} is a mesh without triangles")
        return sdf.mesh_shape(declared.mesh, margin_m)
    if declared.shape == "half_space":
        return sdf.half_space()
    if declared.shape == "box":
        return sdf.box(np.zeros(3) if declared.size_m is None else declared.size_m)
    if declared.shape == "sphere":
        return sdf.sphere(radius)
    if declared.shape == "capsule":
        return sdf.capsule(radius, length)
    if declared.shape == "cylinder":
        return sdf.cylinder(radius, length)
    raise SceneUnsupported(f"collider {declared.name!r} has the unknown shape {declared.shape!r}")


def _rotations(quaternions_wxyz: Array) -> Array:
    matrices: Array = Rotation.from_quat(quaternions_wxyz, scalar_first=True).as_matrix()
    return matrices
