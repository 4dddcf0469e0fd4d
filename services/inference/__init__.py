"""Inference: rollouts, plans and live sessions of published models.

``python -m physworld_services.inference serve`` answers small rollouts and live sessions for the API, which holds no
torch; ``python -m physworld_services.inference work`` is a worker on the ``infer`` queue for long rollouts and for
plans.
"""
