"""Hostile files: a corpus made from a seed, and what each file costs the service that it is sent to."""
