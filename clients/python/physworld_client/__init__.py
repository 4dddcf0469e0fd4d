"""Python SDK of PhysWorld."""
