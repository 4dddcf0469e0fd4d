"""Work without the service: one process, files in, files out.

``physworld NAME`` becomes ``python -m workers.commands.NAME``.
"""
