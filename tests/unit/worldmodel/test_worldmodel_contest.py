"""Networks on both priors of a rope compete, and the one that errs less goes on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hanging_rope import SMALL, episode, graph

from physworld.worldmodel import training as training_module
from physworld.worldmodel import training_run
from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import TrainingDiverged
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.priors.chain import ChainPrior
from physworld.worldmodel.priors.choose import contenders
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return [read_track(graph(3), episode(seed, markers=3), SMALL.history) for seed in range(12)]


def test_the_chain_competes_with_the_better_modal_prior() -> None:
    none = float("nan")
    turned = "modal_in_grip_frame"
    assert contenders({"chain": 2.0, "modal": 1.0, turned: 0.9}) == ["chain", turned]
    assert contenders({"chain": 1.0, "modal": 2.0}) == ["chain", "modal"]
    assert contenders({"chain": 1.0, "modal": none}) == ["chain"]
    assert contenders({"chain": none, "modal": 2.0, turned: none}) == ["modal"]
    assert contenders({"modal": 1.0, turned: 1.2}) == ["modal"]
    assert contenders({"chain": 1.0}) == ["chain"]


COMPETING = TrainingConfig(steps=16, batch_size=1, look_ahead=2, validation_every=4, checkpoint_every=4)


def _after_a_heat(tracks: list[Track], prior: str) -> float:
    """The least validation error [m] of the first two of sixteen steps on that prior alone."""
    alone = train(tracks, graph(3), SMALL, replace(COMPETING, prior=prior, validation_every=2))
    assert alone.prior == prior
    return min(error for step, error in alone.validation if step <= 2)


def test_networks_on_both_priors_compete_and_what_the_priors_err_alone_does_not_decide(
    tracks: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    heats = {name: _after_a_heat(tracks, name) for name in ("chain", "modal")}
    misleading = {name: float(name == min(heats, key=heats.__getitem__)) for name in heats}
    monkeypatch.setattr(
        training_module,
        "prior_error",
        lambda prior, *rest: misleading["chain" if isinstance(prior, ChainPrior) else "modal"],
    )
    seen: list[tuple[int, int]] = []
    saved: list[bytes] = []
    result = train(
        tracks, graph(3), SMALL, COMPETING, save_checkpoint=saved.append,
        progress=lambda done, steps, loss: seen.append((done, steps)),
    )  # fmt: skip
    assert result.heats_m == pytest.approx(heats, rel=1e-6)
    assert result.prior == min(heats, key=heats.__getitem__)
    assert seen == [(done, 18) for done in range(1, 19)]
    for checkpoint in (saved[0], saved[2]):
        resumed = train(tracks, graph(3), SMALL, COMPETING, checkpoint=checkpoint)
        assert (resumed.prior, resumed.heats_m) == (result.prior, result.heats_m)
        assert resumed.validation == result.validation
        for ours, theirs in zip(resumed.model.parameters(), result.model.parameters(), strict=True):
            assert torch.equal(ours, theirs)


def test_both_networks_see_the_same_episodes_arrive(tracks: list[Track]) -> None:
    settings = replace(COMPETING, steps=96, validation_every=96, checkpoint_every=48, start_share=0.5)
    asked: list[int] = []
    saved: list[bytes] = []

    def later(index: int) -> Track:
        asked.append(index)
        return tracks[index]

    whole = train(tracks[:6], graph(3), SMALL, settings, total=12, later=later, save_checkpoint=saved.append)
    assert set(whole.heats_m) == {"chain", "modal"} and whole.episodes == 12
    assert asked == [*range(6, 12)]  # each once, though both networks were trained on the first of them
    alone = train(tracks[:6], graph(3), SMALL, replace(settings, prior=whole.prior), total=12, later=later)
    assert alone.validation[-1] == whole.validation[-1]  # the contest changes nothing of the one that goes on
    resumed = train(tracks[:6], graph(3), SMALL, settings, total=12, later=later, checkpoint=saved[0])
    assert resumed.validation == whole.validation and resumed.prior == whole.prior


def test_a_network_that_diverges_in_its_heat_is_given_up(
    tracks: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(COMPETING, steps=96, validation_every=96)
    best = train(tracks, graph(3), SMALL, settings).prior
    used = training_run.usable

    def exploding(run: training_run.Run, loss: float, norm: float) -> bool:
        return used(run, loss, float("inf") if run.prior in doomed else norm)

    monkeypatch.setattr(training_run, "usable", exploding)
    doomed = {best}
    other = train(tracks, graph(3), SMALL, settings)
    assert other.prior != best and other.heats_m[best] == float("inf")
    doomed = {"chain", "modal"}
    with pytest.raises(TrainingDiverged, match="step 0"):
        train(tracks, graph(3), SMALL, settings)
