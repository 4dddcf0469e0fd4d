"""The error of a recording that cannot be taken."""

from __future__ import annotations

from collections.abc import Sequence

from physworld.errors import PhysworldError
from physworld_schemas.base import FieldError


class SceneInvalid(PhysworldError):
    """A scene bundle with faults: ``faults`` says where and what, each with its numbers."""

    code = "scene_invalid"

    def __init__(self, faults: Sequence[FieldError]) -> None:
        super().__init__("; ".join(f"{'.'.join(map(str, fault.loc))}: {fault.msg}" for fault in faults))
        self.faults = list(faults)


def refused(where: str, message: str) -> SceneInvalid:
    """The error of one fault at one place."""
    return SceneInvalid([FieldError(loc=[where], msg=message)])
