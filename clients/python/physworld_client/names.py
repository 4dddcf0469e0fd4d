"""What people call an object: its id, the beginning of its id, or its name; for both clients and the command line.

An id is taken as it is. Anything else is looked for among the newest ``MOST`` objects: an exact name counts before the
beginning of an id or of a model's name. What fits several, or none, is refused with the ids that come near.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from typing import Any

from physworld_client.errors import AmbiguousName, UnknownName
from physworld_schemas.ids import PREFIXES

MOST = 5000
PAGE = 200
SHOWN = 4
SINGULAR = {
    "scenes": "scene",
    "checks": "check",
    "fits": "fit",
    "traces": "trace",
    "datasets": "dataset",
    "models": "model",
    "assessments": "assessment",
    "loops": "loop",
    "rollouts": "rollout",
    "plans": "plan",
    "videos": "video",
    "jobs": "job",
    "keys": "key",
}
"""The client's resources whose objects are looked up, and what one of each is called."""
WITH_NAMES = frozenset({"scenes", "keys"})
_MODEL = re.compile(r"[a-z0-9][a-z0-9._-]*")
_ID = re.compile(r"[a-z]{3}_[0-9A-HJKMNP-TV-Z]{26}")


def is_id(resource: str, given: str) -> bool:
    """Whether a text is an id as it stands, so that nothing has to be looked up.

    A model is known by its name, and any name of a model may be the beginning of another; what can be none is left to
    the request, which says what is wrong with it.
    """
    return not _MODEL.fullmatch(given) if resource == "models" else bool(_ID.fullmatch(given))


@dataclass
class Search:
    """The search for what a text names among the objects of a resource.

    Attributes:
        resource: of the client: "scenes".
        given: the text.
        known: id and name of every object seen so far; of a model the name in both places.
    """

    resource: str
    given: str
    known: list[tuple[str, str]] = field(default_factory=list)

    def see(self, item: Any) -> bool:
        """Takes note of an object; whether further ones are to be looked at."""
        if self.resource == "models":
            self.known.append((item.name, item.name))
        else:
            self.known.append((item.id, item.name if self.resource in WITH_NAMES else ""))
        return len(self.known) < MOST

    def found(self) -> str:
        """The id (of a model: the name) of the one object that fits.

        Raises:
            UnknownName: nothing is called that.
            AmbiguousName: several are.
        """
        exact = [identifier for identifier, name in self.known if self.given in (identifier, name)]
        begun = [identifier for identifier, _ in self.known if self._begins(identifier)]
        fitting = exact or begun
        if len(fitting) == 1:
            return fitting[0]
        if not fitting:
            raise self._unknown()
        more = f" and {len(fitting) - SHOWN} more" if len(fitting) > SHOWN else ""
        text = f"{len(fitting)} {self.resource} fit {self.given!r}: {', '.join(fitting[:SHOWN])}{more}"
        raise AmbiguousName(text, tuple(fitting))

    def _begins(self, identifier: str) -> bool:
        """Whether an id begins so, with or without what all ids of its kind begin with; letters of either case."""
        whole, begun = identifier.lower(), self.given.lower()
        what = SINGULAR[self.resource]
        prefix = PREFIXES.get("job" if what == "loop" else what)  # a loop's id is its job's
        return bool(begun) and (
            whole.startswith(begun) or (prefix is not None and whole.startswith(f"{prefix}_{begun}"))
        )

    def _unknown(self) -> UnknownName:
        """The error for a text that names nothing, with what is called nearly so, or the newest."""
        names = {name: identifier for identifier, name in reversed(self.known) if name}
        near = difflib.get_close_matches(self.given, names, SHOWN)
        if near:
            candidates = tuple(names[name] for name in near)
            hint = f"the nearest: {', '.join(_called(names[name], name) for name in near)}"
        else:
            newest = self.known[:SHOWN]
            candidates = tuple(identifier for identifier, _ in newest)
            hint = f"the newest: {', '.join(_called(*one) for one in newest)}" if newest else "there is none"
        looked = f" among the newest {MOST}" if len(self.known) >= MOST else ""
        what = SINGULAR[self.resource]
        text = f"no {what} is called {self.given!r} and no id begins so{looked}; {hint}"
        return UnknownName(text, candidates)


def _called(identifier: str, name: str) -> str:
    """``strip (scn_01JZ…)``; only the one where both are the same or there is no name."""
    return f"{name} ({identifier})" if name and name != identifier else identifier
