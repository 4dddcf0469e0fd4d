"""Motions that would tell models apart: see :func:`physworld.experiments.proposal.propose`."""

from physworld.experiments.proposal import Experiment, propose
from physworld.experiments.rivals import Rival, rival_of
from physworld.experiments.search import ExperimentConfig

__all__ = ["Experiment", "ExperimentConfig", "Rival", "propose", "rival_of"]
