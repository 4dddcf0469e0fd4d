"""Work without the service: one process, files in, files out.

``physworld NAME`` becomes ``python -m physworld_workers.commands.NAME``.
"""
