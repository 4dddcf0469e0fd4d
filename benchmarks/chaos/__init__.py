"""Faults made on purpose: what the processes of a service are exposed to while they work."""
