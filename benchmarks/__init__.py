"""Benchmarks: what prints every number in ``docs/benchmarks.md``, with peers measured in the same run."""
