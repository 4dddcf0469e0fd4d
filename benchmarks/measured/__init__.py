"""Measured recordings: the default twin beside every baseline and peer (``python -m benchmarks.measured``)."""
