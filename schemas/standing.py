"""What has become of an object in the words of its lists: its state, or why being ready is not the whole of it.

A fit whose search spent its budget is ready and has no optimum; a version that failed the quality gate is ready and
does not become ``latest``. Command line and dashboard call neither of them just ready.
"""

from __future__ import annotations

NOT_CONVERGED = "not converged"
FAILED_GATE = "failed the gate"
_LOOKS = {NOT_CONVERGED: "cancelling", FAILED_GATE: "failed"}


def standing_of(state: str, *, converged: bool | None = None, verdict: str = "") -> str:
    """The state of an object, or what is wrong with it though it is ready.

    Args:
        state: as it is stored.
        converged: of a fit, whether its search ended by itself; None: it does not say.
        verdict: of a version, that of the quality gate.
    """
    if state == "ready" and converged is False:
        return NOT_CONVERGED
    if state == "ready" and verdict == "failed":
        return FAILED_GATE
    return state


def look_of(standing: str) -> str:
    """The state whose colour the dashboard gives it."""
    return _LOOKS.get(standing, standing)
