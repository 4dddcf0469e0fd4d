"""The choice of a formulation, and its reason."""

from __future__ import annotations

from typing import get_args

import pytest

from physworld.engine.formulations import FORMULATIONS, TOTAL, UPDATED, choose_formulation
from physworld.errors import SceneUnsupported
from physworld.materials.plastic import DruckerPrager, Identity, VonMises
from physworld_schemas.fit import FitConfig


def test_elastic_bodies_are_integrated_without_transfers() -> None:
    for dimension in (3, 2, 1):
        assert choose_formulation(dimension, {}).formulation.name == "total_lagrangian"


@pytest.mark.parametrize(
    ("declared", "plasticity", "why"),
    [
        ({}, VonMises(1e3), "von_mises"),
        ({}, DruckerPrager(0.5), "drucker_prager"),
        ({}, Identity(), "return mapping"),
        ({"body": {"self_contact": True}}, None, "self_contact"),
        ({"body": {"topology_change": True}}, None, "topology_change"),
    ],
)
def test_what_flows_parts_or_touches_itself_is_carried_by_particles(
    declared: dict, plasticity: object, why: str
) -> None:
    choice = choose_formulation(3, declared, plasticity)  # type: ignore[arg-type]
    assert choice.formulation.name == "updated_lagrangian"
    assert why in choice.reason


def test_a_person_may_overrule_the_choice() -> None:
    total = choose_formulation(3, {"body": {"self_contact": True}}, asked="total_lagrangian")
    assert total.formulation.name == "total_lagrangian"
    assert choose_formulation(3, {}, asked="updated_lagrangian").reason == "asked for"


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(SceneUnsupported, match="dimension 2"):
        choose_formulation(2, {}, asked="updated_lagrangian")
    with pytest.raises(SceneUnsupported, match="von_mises flow needs"):
        choose_formulation(3, {}, VonMises(1.0), asked="total_lagrangian")
    with pytest.raises(ValueError, match="no formulation is called 'eulerian'"):
        choose_formulation(3, {}, asked="eulerian")


def test_a_formulation_says_what_may_be_asked_of_its_runs() -> None:
    for ability in ("gradients", "batches", "soft_grips", "friction_field"):
        assert TOTAL.supports(ability) and not UPDATED.supports(ability)
    assert UPDATED.on_particles and not TOTAL.on_particles
    on_the_wire = get_args(FitConfig.model_fields["formulation"].annotation)
    assert {"auto", *FORMULATIONS} == set(on_the_wire)
