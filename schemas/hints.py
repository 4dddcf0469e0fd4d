"""What to do about a problem, by its code: the ``hint`` of a problem document whose maker knows no better one."""

from __future__ import annotations

HINTS = {
    "scene_invalid": "`physworld scenes check SCENE` names its faults without the service; docs/scenes.md tells all.",
    "scene_unsupported": "docs/scenes.md says which bodies and motions are simulated.",
    "unauthenticated": "Send `Authorization: Bearer KEY`; the embedded service keeps its key in DATA/api-key.",
    "forbidden": "Use a key with the role that is named; `physworld keys list` shows the roles.",
    "not_found": "The lists of the API, of the dashboard and of the command line hold what there is.",
    "invalid_cursor": "Begin the list anew without a cursor.",
    "idempotency_key_reused": "Send a new Idempotency-Key with a new body.",
    "content_too_large": "Send less at once; docs/api.md names the limits under Upload.",
    "too_many_requests": "Wait for as long as Retry-After says.",
    "unavailable": "Try again in a moment; nothing was changed.",
    "database_unavailable": "Try again in a moment; nothing was changed.",
    "store_read_failed": "Try again in a moment; nothing was changed.",
    "store_write_failed": "Try again in a moment; nothing was changed.",
    "store_full": "Make room where the artifacts lie, or delete objects that nothing uses.",
    "budget_exceeded": "Ask for fewer episodes, frames or particles, or make room on the disk.",
    "unstable_simulation": "Ask for fewer particles; a law or a formulation named by hand may not suit the motion.",
    "blew_up": "Ask for fewer particles; a law or a formulation named by hand may not suit the motion.",
    "cfl_violation": "Leave the time step to the engine, which takes the stable one.",
    "particles_left_the_grid": "Check the units and the ground of the recording: material left what it spans.",
    "calibration_error": "See the fit's notes; fewer particles, more simulations or another law may help.",
    "training_diverged": "Train with a lower learning_rate.",
    "episode_rejected": "Allow more tries, or ask for calmer motions (curvature_limit, perturbation).",
    "tracking_failed": "Draw the box closer, or give more light and texture; docs/recording.md says how.",
    "simulation_error": "Ask for fewer particles or another formulation; docs/engine.md says what bounds the step.",
    "dataset_incomplete": "Retry the job: the episodes that are stored stay.",
    "artifact_corrupt": "The file was changed where it lies: restore it from a backup, or make the object anew.",
    "episode_corrupt": "The episode was changed where it lies: restore it from a backup, or make the dataset anew.",
    "internal_error": "The service's log holds the traceback under this request id.",
}
"""By code of the problem. A code without a line has no hint, and its document no such member."""


def hint_of(code: str) -> str | None:
    """The hint of a code, None where nothing is known."""
    return HINTS.get(code)
