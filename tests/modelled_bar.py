"""Fits of the sagging bar with an effect, at places where a search may have left them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sagging_bar import BUDGET, SIGMA, TRUE_PA, sagging

from physworld.calibrate.parameters import parameters_of
from physworld.effects.base import Effect
from physworld.effects.registry import effect
from physworld.estimation.refit import Refit, sensitivities
from physworld.estimation.simulations import Job
from physworld.estimation.unknowns import Unknown
from physworld.estimation.whitening import whitener
from physworld.trace.candidates import candidates
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.trace.unknowns import of_parameter
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin


class Bar:
    """A bar with an effect, and fits of it at places where a search may have left them."""

    def __init__(self, acts: Effect) -> None:
        scene = sagging(acts)
        self.plain = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
        recordings = Recordings([scene], (), 12, 3)
        self.frames = recordings.split.train[1]
        self.simulations = JointSimulations(recordings, self.plain, BUDGET, 1.25)
        _, answers = self.simulations.first_look(Job(self.plain, self.frames))
        self.white = whitener(recordings.scene, recordings.split, SIGMA, answers)

    def model(
        self, name: str, youngs_modulus_pa: float, shape: dict[str, float] | None = None, **strength: float
    ) -> Refit:
        """With one effect, not searched any further; with a shape, of which a search is free to change some."""
        twin = self.plain.with_parameters(youngs_modulus_pa=youngs_modulus_pa).with_effect(
            effect(name, **strength, **(shape or {}))
        )
        member = candidates(self.plain, (name,))[0][0]
        if shape is not None:
            member = replace(member, fixed=shape)
        gates = [
            g.starting(value / g.value(1.0))
            for g, value in zip(member.unknowns(), strength.values(), strict=True)
        ]
        return self._at(twin, gates + (member.shape_unknowns() if shape is not None else []))

    def _at(self, twin: Twin, own: list[Unknown]) -> Refit:
        known = parameters_of(twin, separate_bending=False, damping=False)
        unknowns = [of_parameter(p, twin, None) for p in known if p.name == "youngs_modulus_pa"] + own
        tracks = self.simulations.run([Job(twin, self.frames)])[0]
        slope, _ = sensitivities(self.simulations, self.white, twin, tracks, unknowns, self.frames)
        place = np.array([u.start for u in unknowns])
        return Refit(unknowns, twin, place, tracks, self.white.residual(tracks), slope)
