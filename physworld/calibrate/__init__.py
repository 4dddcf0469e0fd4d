"""Calibration of a twin on the training frames of a recording."""

from physworld.calibrate.carry import carried_over
from physworld.calibrate.estimates import Correlations, Estimate
from physworld.calibrate.global_stage import CalibrationConfig, FitResult, calibrate
from physworld.calibrate.stages import Stages, calibrate_in_stages
from physworld.estimation.journal import Journal

__all__ = [
    "CalibrationConfig",
    "Correlations",
    "Estimate",
    "FitResult",
    "Journal",
    "Stages",
    "calibrate",
    "calibrate_in_stages",
    "carried_over",
]
