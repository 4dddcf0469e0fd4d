"""Errors of the library. Every message carries the numbers that broke.

PhysworldError
├── SceneUnsupported        the scene lacks what a twin needs (a size, a topology), or has what no law covers yet
├── SimulationError         a simulation cannot be trusted
│   ├── UnstableSimulation  a state is not finite, or an element inverted
│   │   └── BlewUp          it is not finite
│   ├── CFLViolation        a forced time step exceeds the stable one
│   ├── ParticlesLeftTheGrid  material left the stated workspace
│   ├── TwistLost           a rope folded, or a grip turned so far in a frame that its turns cannot be counted
│   ├── ContactFailed       a collider is too fast for its contact, or material came too deep into it or is crushed
│   └── EpisodeRejected     every try at a demonstration was rejected
├── UnknownEffect           no effect or strength of that name
├── EffectRefused           the effect makes no sense for this twin
├── BatchRefused            the episodes cannot be integrated side by side
├── NotDifferentiable       a gradient was asked of what has none
├── CalibrationError        no parameter gave a usable simulation
├── LawAnswerRefused        a model's answer names no law of the library, or not in the asked form
├── LawAnswerUnavailable    the model that was asked gave no answer
├── TrackingFailed          pictures show too little of the object to follow it
├── SplatNotFitted          or too little to fit a splat to
├── Cancelled               the caller asked to stop
└── WorkerLost              a process that shares simulations ended
"""

from __future__ import annotations


class PhysworldError(Exception):
    """Root of the library's errors."""


class SceneUnsupported(PhysworldError):
    """The scene lacks what a twin needs, or has what no formulation covers yet."""


class SimulationError(PhysworldError):
    """A simulation cannot be trusted."""


class UnstableSimulation(SimulationError):
    """A state is not finite, or an element inverted."""


class BlewUp(UnstableSimulation):
    """Positions left the numbers: the time step was too long for what the body had become."""


class CFLViolation(SimulationError):
    """A forced time step exceeds the stable one."""


class ParticlesLeftTheGrid(SimulationError):
    """Material left the stated workspace."""


class ContactFailed(SimulationError):
    """A collider is too fast for its contact, or material came too deep into it or is crushed by it."""


class TwistLost(SimulationError):
    """A rope folded, or a grip turned so far in a frame, that its turns cannot be counted."""


class EpisodeRejected(SimulationError):
    """Every try at a demonstration was rejected."""


class UnknownEffect(PhysworldError):
    """No effect or strength of that name."""


class EffectRefused(PhysworldError):
    """The effect makes no sense for this twin."""


class BatchRefused(PhysworldError):
    """The episodes cannot be integrated side by side."""


class NotDifferentiable(PhysworldError):
    """A gradient was asked of what has none."""


class CalibrationError(PhysworldError):
    """No parameter gave a usable simulation."""


class LawAnswerRefused(PhysworldError):
    """A model's answer names no law of the library, or not in the asked form."""


class LawAnswerUnavailable(PhysworldError):
    """The model that was asked gave no answer."""


class TrackingFailed(PhysworldError):
    """Pictures show too little of the object, or of its grips, to follow them."""


class Cancelled(PhysworldError):
    """The caller asked to stop."""


class WorkerLost(PhysworldError):
    """A process that shares simulations ended."""


class GaussiansUnreadable(PhysworldError):
    """A splat is not of the layout that it must have, or holds numbers that are none."""


class SplatNotFitted(PhysworldError):
    """The pictures do not show enough of an object to fit a splat to."""
