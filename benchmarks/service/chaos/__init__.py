"""Faults on a running service, by the hundred, and a ledger of what they cost: ``python -m benchmarks.service.chaos``.

``plan`` draws the faults from a seed, ``embedded`` and ``distributed`` start the service's real processes and do them
harm, ``work`` uploads recordings and asks for pipelines all the while, ``run`` ties them together, and ``ledger``
counts, once everything has ended, what the database and the store hold against what was asked for. ``proxy`` and
``store_proxy`` stand between a service and its servers, also in tests.
"""
