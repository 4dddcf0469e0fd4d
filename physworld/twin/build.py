"""Makes a twin of a scene: its body, its grips, its formulation, and prior parameters that a calibration changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.engine.formulations import RODS, Formulation, choose_formulation
from physworld.engine.rods.chain import Chain
from physworld.engine.thin.self_contact import COARSE, apart_m, refuse_thickness
from physworld.engine.thin.triangles import Mesh
from physworld.engine.updated.transfer import TRANSFERS, Apic
from physworld.errors import SceneUnsupported
from physworld.geometry.body import ReferenceBody
from physworld.geometry.declared import grips_of
from physworld.geometry.hung_sheet import upper_edge
from physworld.geometry.reference import reference_body
from physworld.geometry.rigid import rigid_groups
from physworld.geometry.rod_body import KINDS as ROD_KINDS
from physworld.geometry.rod_body import SLENDER, is_discrete
from physworld.geometry.sheet_body import is_hung_sheet
from physworld.materials.cable import CableLaw
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.plastic import Plasticity
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.colliders import carried, twin_colliders
from physworld.twin.grips import declared_region, gripped_nodes, why_no_turn
from physworld.twin.openings import opening_of
from physworld.twin.rods import clamped, natural_of
from physworld.twin.twin import Twin

PRIOR_DENSITY_KG_M3 = 1000.0
PRIOR_FRICTION = 0.5
_RELEASE_SIGMAS = 10.0
_RELEASE_SHARE = 2e-3  # motion below this share of the body's size is not a release
_DRIVEN_SHARE = 5e-4  # controllers that moved this share of the body's size drive it


def build_twin(
    scene: Scene,
    particle_budget: int = 2000,
    device: str | None = None,
    refinement: float = 1.0,
    plasticity: Plasticity | None = None,
    formulation: str = "auto",
    transfer: str = Apic.name,
    mesh: Mesh | None = None,
) -> Twin:
    """A twin of the scene with prior parameters, to be calibrated.

    Args:
        scene: the recording.
        particle_budget: about how many particles a solid gets, see :func:`physworld.geometry.reference.reference_body`
            for sheets and rods.
        device: Warp device of the simulations; by default :func:`physworld.devices.default_device`.
        refinement: cells are this many times smaller along every axis, whatever the body.
        plasticity: flow law, or None.
        formulation: "total_lagrangian", "updated_lagrangian", or "auto": by the law and the scene. The body's notes say
            which was taken and why.
        transfer: of the updated Lagrangian form, "apic" or "asflip" (:mod:`physworld.engine.updated.transfer`).
        mesh: of a sheet, the mesh of linear triangles that it is to be (:mod:`physworld.engine.thin.triangles`).

    Raises:
        SceneUnsupported: the scene declares too little for a body, or the formulation cannot hold it.
        ValueError: there is no such formulation or transfer.
    """
    if transfer not in TRANSFERS:
        raise ValueError(f"no transfer is called {transfer!r}; there are {sorted(TRANSFERS)}")
    discrete = scene.kind in ROD_KINDS and formulation == RODS.name
    discrete |= formulation == "auto" and plasticity is None and is_discrete(scene)
    body = reference_body(scene, particle_budget, refinement, mesh, discrete)
    choice = choose_formulation(body.lattice.dim, scene.declared, plasticity, formulation, discrete)
    taken_form = f"{choice.formulation.title} form: {choice.reason}"
    if choice.formulation.on_particles:
        taken_form += f"; transfers by {transfer}"
    body = replace(body, notes=(*body.notes, taken_form))
    _, controls = scene.control_track()
    reach = 0.6 * float(np.ptp(body.start, axis=0).max())
    if discrete and scene.kind in SLENDER:  # all markers that keep their distances are on its base
        reach = np.inf
    grips = grips_of(scene)
    if grips:
        groups = tuple(np.array(g.controllers, dtype=int) for g in grips)
    else:
        free = np.setdiff1d(np.arange(controls.shape[1]), carried(scene))
        groups = tuple(free[group] for group in rigid_groups(controls[:, free], reach))
    held, taken = [], np.empty(0, dtype=int)
    for number, group in enumerate(groups):
        region = grips[number] if grips else None
        if region is not None and any(begin <= 0 < end for begin, end in region.open_s):
            held.append(np.empty(0, dtype=int))
            continue
        nodes = np.setdiff1d(gripped_nodes(body, controls[0, group], region), taken)
        if isinstance(body.lattice, Chain) and scene.kind in SLENDER:
            nodes = clamped(body.lattice, nodes)
        held.append(nodes)
        taken = np.concatenate([taken, nodes])
    if is_hung_sheet(scene, mesh):
        groups, held = (np.arange(2),), [upper_edge(body.lattice)]
    openings = tuple(opening_of(grip, scene.times) for grip in grips)
    openings = openings if any(one is not None for one in openings) else ()
    if openings and choice.formulation.on_particles:
        raise SceneUnsupported(
            f"{sum(one is not None for one in openings)} of {len(grips)} grips let go, which the updated Lagrangian "
            "form does not follow"
        )
    turning, notes = _turning(scene, body, controls[0], groups, held)
    self_friction, touching = _touching_itself(scene, body, choice.formulation)
    body = replace(body, notes=(*body.notes, *notes, *touching))
    friction = scene.ground.friction if scene.ground is not None else None
    return Twin(
        body=body,
        law=_prior_law(scene, body),
        gravity_m_s2=np.asarray(scene.gravity_m_s2, dtype=float),
        air_drag_per_s=0.0,
        ground_height_m=scene.ground.height_m if scene.ground is not None else None,
        ground_friction=PRIOR_FRICTION if friction is None else friction,
        controller_groups=groups,
        held_nodes=tuple(held),
        grip_regions=tuple(
            declared_region(grips[k] if grips else None, body.lattice.dim) for k in range(len(groups))
        ),
        controllers_start=controls[0],
        release_s=0.0 if body.settles else _release_time(scene),
        turning=turning,
        natural=natural_of(body, len(groups)),
        colliders=twin_colliders(scene, body.half_thickness_m, PRIOR_FRICTION),
        self_friction=self_friction,
        openings=openings,
        plasticity=plasticity,
        formulation=choice.formulation.name,
        transfer=transfer,
        device=device or default_device(),
    )


def _turning(
    scene: Scene,
    body: ReferenceBody,
    first: Array,
    groups: tuple[Array, ...],
    held: list[Array],
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Grips of a rope between which it carries twist, and a note on every other one; of one grip alone nothing."""
    if body.lattice.dim != 1 or sum(len(nodes) > 0 for nodes in held) < 2:
        return (), ()
    reasons = {
        number: why_no_turn(body, nodes, first[group], scene.noise_sigma_m)
        for number, (group, nodes) in enumerate(zip(groups, held, strict=True))
        if len(nodes)
    }
    turning = tuple(number for number, reason in reasons.items() if reason is None)
    notes = [f"grip {number} prescribes no twist: {reason}" for number, reason in reasons.items() if reason]
    if len(turning) > 1:
        notes.append(f"twist is carried between grips {', '.join(map(str, turning))}")
    return turning, tuple(notes)


def _touching_itself(
    scene: Scene, body: ReferenceBody, formulation: Formulation
) -> tuple[float | None, tuple[str, ...]]:
    """Friction of a rope or sheet against itself where its scene declares that it touches itself, and notes on that.

    Raises:
        SceneUnsupported: the friction is no number of 0 or more, or the body is too thin for its cells.
    """
    declared = scene.declared.get("body") or {}
    if not declared.get("self_contact"):
        return None, ()
    if body.lattice.dim == 3:
        if formulation.on_particles:
            return None, ()
        return None, (
            "it is declared to touch itself, and passes through itself: a solid in the total Lagrangian form",
        )
    if not body.lattice.smooth:
        raise SceneUnsupported(
            f"a mesh of {len(body.lattice.cells)} cells of triangles does not touch itself"
        )
    friction = declared.get("self_friction")
    said = "declared"
    if friction is None:
        friction, said = PRIOR_FRICTION, "assumed"
    if isinstance(friction, bool) or not isinstance(friction, int | float) or not 0 <= friction < np.inf:
        raise SceneUnsupported(f"body.self_friction is {friction!r}; it is Coulomb's coefficient, 0 or more")
    thickness, cell = 2 * body.half_thickness_m, float(body.lattice.spacing.max())
    refuse_thickness(body.lattice, thickness)
    notes = [
        f"it touches itself {thickness:.3g} m apart, with friction {friction:g} ({said}); places less than "
        f"{apart_m(body.lattice, thickness):.3g} m apart along it do not"
    ]
    if thickness < COARSE * cell:
        notes.append(
            f"layers {thickness:.3g} m thick may cross where they bend within a cell of {cell:.3g} m: take finer cells"
        )
    return float(friction), tuple(notes)


def _prior_law(scene: Scene, body: ReferenceBody) -> Law:
    facts, lattice = scene.body, body.lattice
    measure = float(lattice.particle_measures.sum())
    section = {3: 1.0, 2: body.thickness_m, 1: np.pi * body.thickness_m**2}[lattice.dim]
    if facts.density_kg_m3 is not None:
        density = facts.density_kg_m3 * section
    elif facts.mass_kg is not None:
        density = facts.mass_kg / measure
    else:
        density = PRIOR_DENSITY_KG_M3 * section
    modulus = 1e5
    if lattice.dim == 3:
        return NeoHookean(youngs_modulus_pa=modulus, density_kg_m3=density)
    if lattice.dim == 2:
        membrane = modulus * section / (1 - 0.3**2)
        return SheetLaw(membrane, membrane * section**2 / 12, density_kg_m2=density)
    of_rods = CableLaw if isinstance(lattice, Chain) else RodLaw
    prior = of_rods(stretching_n=density * 40.0**2, bending_n_m2=density * 1e-2, density_kg_m=density)
    return replace(prior, torsion_ratio=_torsion_ratio(scene, prior.torsion_ratio))


def _torsion_ratio(scene: Scene, prior: float) -> float:
    """GJ / EI as ``body.torsion_ratio`` declares it, else ``prior``."""
    declared = (scene.declared.get("body") or {}).get("torsion_ratio")
    if declared is None:
        return prior
    if isinstance(declared, bool) or not isinstance(declared, int | float) or not 0 <= declared < np.inf:
        raise SceneUnsupported(
            f"body.torsion_ratio is {declared!r}; it is GJ / EI of a rope, 0 or more (0: no twist)"
        )
    return float(declared)


def _release_time(scene: Scene) -> float:
    """When a body that is held by nobody known starts to move [s]; 0 where it moves from the start.

    A body that neither moves nor is moved stays where it is in any case, so holding it changes nothing; one that
    starts out of balance (kept level by a hand, say) falls only when it is let go.
    """
    if scene.initial_state != AS_MEASURED:
        return 0.0
    first = np.concatenate([scene.points[0][scene.visible[0]], scene.controllers[0]])
    size = float(np.ptp(first, axis=0).max())
    limit = max(_RELEASE_SIGMAS * (scene.noise_sigma_m or 0.0), _RELEASE_SHARE * size)
    moved = np.linalg.norm(scene.points - scene.points[0], axis=2)
    seen = np.where(scene.visible & scene.visible[0], moved, np.nan)
    usable = ~np.isnan(seen).all(axis=1)
    moved = np.zeros(len(seen), dtype=bool)
    # The median: one point's jump is a tracker's, not a release.
    moved[usable] = np.nanmedian(seen[usable], axis=1) > limit
    driven = (
        np.linalg.norm(scene.controllers - scene.controllers[0], axis=2).max(axis=1, initial=0.0)
        > _DRIVEN_SHARE * size
    )
    released = int(np.argmax(moved)) if moved.any() else 0
    if released >= scene.train[1] or driven[: released + 1].any():
        return 0.0
    return float(scene.times[max(released - 1, 0)])


def taken_over(twin: Twin, other: Twin) -> Twin:
    """``other``'s body, start and grips with the parameters and effects of ``twin``."""
    return replace(
        other,
        natural=twin.natural if other.natural is not None else None,
        law=twin.law,
        air_drag_per_s=twin.air_drag_per_s,
        grip_softness=twin.grip_softness,
        ground_friction=twin.ground_friction,
        effects=twin.effects,
    )
