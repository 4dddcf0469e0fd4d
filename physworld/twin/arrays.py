"""A twin as plain arrays, fit for an npz without pickle, and back: what is stored and what is sent to workers."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import effect
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.rods.chain import Chain
from physworld.engine.thin.triangles import TriangleLattice
from physworld.geometry.body import ReferenceBody
from physworld.materials.library import law_class
from physworld.materials.plastic import PLASTICITIES
from physworld.twin.colliders import from_parts, to_parts
from physworld.twin.openings import Opening

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_BODY = ("rest", "start", "start_velocity", "points", "offsets")


def arrays_of(twin: Twin) -> dict[str, Array]:
    """Everything of a twin; what is no array is JSON under ``facts``."""
    lattice, body = twin.lattice, twin.body
    collider_facts, collider_arrays = to_parts(twin.colliders)
    facts = {
        "law": twin.law.name,
        "law_parameters": asdict(twin.law),
        "air_drag_per_s": twin.air_drag_per_s,
        "ground_height_m": twin.ground_height_m,
        "ground_friction": twin.ground_friction,
        "release_s": twin.release_s,
        "release_delay_s": twin.release_delay_s,
        "grip_softness": twin.grip_softness,
        "grip_regions": [None if region is None else region.tolist() for region in twin.grip_regions],
        "thickness_m": body.thickness_m,
        "notes": list(body.notes),
        "settles": body.settles,
        "groups": [g.tolist() for g in twin.controller_groups],
        "held": [h.tolist() for h in twin.held_nodes],
        "turning": list(twin.turning),
        "effects": [{"name": known.name, "strengths": known.values} for known in twin.effects],
        "colliders": collider_facts,
        "self_friction": twin.self_friction,
        "formulation": twin.formulation,
        "transfer": twin.transfer,
        **(
            {}
            if not twin.openings
            else {"openings": [None if o is None else asdict(o) for o in twin.openings]}
        ),
        "plasticity": None
        if twin.plasticity is None
        else {"name": twin.plasticity.name, "parameters": asdict(twin.plasticity)},
    }
    return {
        "facts": np.array(json.dumps(facts)),
        "gravity": np.asarray(twin.gravity_m_s2, dtype=float),
        "controllers_start": twin.controllers_start,
        **{f"lattice_{f.name}": np.asarray(getattr(lattice, f.name)) for f in fields(lattice)},
        **{f"body_{name}": getattr(body, name) for name in _BODY},
        **({} if body.added_mass is None else {"body_added_mass": body.added_mass}),
        **({} if twin.properties is None else {"properties": twin.properties}),
        **({} if twin.natural is None else {"natural": twin.natural}),
        **({} if twin.drive is None else {"drive": twin.drive}),
        **collider_arrays,
    }


def parts_of(arrays: dict[str, Array]) -> dict[str, Any]:
    """The arguments of :class:`physworld.twin.twin.Twin` but for its device; what older twins lack has its default."""
    facts = json.loads(str(arrays["facts"]))
    flow = facts.get("plasticity")
    held = {f.name: arrays[f"lattice_{f.name}"] for f in fields(Lattice)}
    lattice = Lattice(**held)
    if "lattice_odd" in arrays:
        lattice = TriangleLattice(**held, odd=bool(arrays["lattice_odd"]))
    elif "lattice_parent" in arrays:
        lattice = Chain(**held, parent=arrays["lattice_parent"], lengths=arrays["lattice_lengths"])
    body = ReferenceBody(
        lattice=lattice,
        thickness_m=facts["thickness_m"],
        notes=tuple(facts["notes"]),
        added_mass=arrays.get("body_added_mass"),
        settles=facts.get("settles", False),
        **{name: arrays[f"body_{name}"] for name in _BODY},
    )
    return {
        "body": body,
        "law": law_class(facts["law"], lattice.dim)(**facts["law_parameters"]),
        "gravity_m_s2": arrays["gravity"],
        "air_drag_per_s": facts["air_drag_per_s"],
        "ground_height_m": facts["ground_height_m"],
        "ground_friction": facts["ground_friction"],
        "controller_groups": tuple(np.array(g, dtype=int) for g in facts["groups"]),
        "held_nodes": tuple(np.array(h, dtype=int) for h in facts["held"]),
        "controllers_start": arrays["controllers_start"],
        "release_s": facts["release_s"],
        "release_delay_s": facts.get("release_delay_s", 0.0),
        "grip_softness": facts.get("grip_softness", 0.0),
        "grip_regions": tuple(
            None if region is None else np.array(region) for region in facts.get("grip_regions", ())
        ),
        "turning": tuple(facts.get("turning", ())),
        "effects": tuple(effect(e["name"], **e["strengths"]) for e in facts.get("effects", ())),
        "colliders": from_parts(facts.get("colliders", []), arrays, body.half_thickness_m),
        "self_friction": facts.get("self_friction"),
        "plasticity": None if flow is None else PLASTICITIES[flow["name"]](**flow["parameters"]),
        "formulation": facts.get("formulation", "total_lagrangian"),
        "transfer": facts.get("transfer", "apic"),
        "properties": arrays.get("properties"),
        "natural": arrays.get("natural"),
        "drive": arrays.get("drive"),
        "openings": tuple(
            None if one is None else Opening(tuple(map(tuple, one["open_s"])), one["radius_m"])
            for one in facts.get("openings", ())
        ),
    }
