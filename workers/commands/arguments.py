"""Numbers on a command line, refused where they mean nothing."""

from __future__ import annotations

import argparse
import math


def count_of(text: str) -> int:
    """A whole number from 1 on."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is below 1")
    return value


def minutes(text: str) -> float:
    """A time, perhaps 0 [min]."""
    value = float(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no number of minutes")
    return value


def metres(text: str) -> float:
    """A length above 0 [m]."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is no positive number of metres")
    return value
