"""Calibration of a twin on the training frames of a recording."""

from physworld.calibrate.global_stage import CalibrationConfig, Estimate, FitResult, calibrate

__all__ = ["CalibrationConfig", "Estimate", "FitResult", "calibrate"]
