"""Closed surfaces: triangle meshes and signed distances, on the host and on the device; no body, no scene."""
