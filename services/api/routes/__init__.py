"""One file of routes per resource: the application includes the ``router`` of each of them under ``/v1``."""
