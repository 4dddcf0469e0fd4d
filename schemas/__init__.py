"""The wire's nouns: pydantic models that the API, the SDK, the workers and the storage share.

This package imports nothing else of ours. Library code (``physworld``) never sees these models.
"""
