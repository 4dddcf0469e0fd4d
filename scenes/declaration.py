"""The form of ``scene.json``, schema version 1: types and ranges of every key that the service reads.

Keys that it does not read (in ``body``, ``topology`` and ``notes``) pass through untouched, up to ``MAX_UNREAD_BYTES``
in all. What the numbers
mean together with the arrays is the business of ``scene_validation``.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from physworld_schemas.base import FieldError

SCHEMA_VERSION = 1
MAX_JSON_BYTES = 2 << 20
MAX_JSON_VALUES = 200_000
MAX_UNREAD_BYTES = 64 << 10
"""Of what the keys hold that nobody reads: they travel with the scene, and lie in the database."""
MAX_DEPTH = 64
UNDEFORMED_TEXT = "undeformed and at rest at t=0; gravity acts from t=0"

Kind = Literal["beam", "block", "blob", "toy", "sheet", "rope", "rod", "branched_rope", "arm", "trunk"]
KINDS: tuple[str, ...] = get_args(Kind)

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0)]
Vector = tuple[Number, Number, Number]
Size = tuple[Positive, Positive, Positive]
Index = Annotated[int, Field(ge=0)]


def _known_state(text: str) -> str:
    if text != "as measured" and not text.startswith("undeformed"):
        raise ValueError(f'is {text!r}; known are "{UNDEFORMED_TEXT}" and "as measured"')
    return text


class Form(BaseModel):
    """Base: unknown keys are kept, numbers are not read out of strings."""

    model_config = ConfigDict(extra="allow", strict=True)


class Split(Form):
    """Half-open frame ranges."""

    train: tuple[int, int]
    test: tuple[int, int]


class Topology(Form):
    """How tracked points are connected: pairs, or an n x n grid (point i * n + j, i right, j down)."""

    edges: list[tuple[Index, Index]] | None = None
    n: Annotated[int, Field(ge=1)] | None = None


class TipLoad(Form):
    """A mass that hangs from a solid, at a point or along a line, or where a text says in its declared box."""

    mass_kg: Positive
    place_m: Vector | tuple[Vector, Vector] | None = None
    where: str | None = None


class BodyForm(Form):
    """What is known of the object."""

    size_m: Size | None = None
    box_min_m: Vector | None = None
    box_max_m: Vector | None = None
    length_m: Positive | None = None
    side_m: Positive | None = None
    thickness_m: Positive | None = None
    radius_m: Positive | None = None
    density_kg_m3: Positive | None = None
    mass_kg: Positive | None = None
    segment_rest_lengths_m: list[Positive] | None = None
    topology: Topology | None = None
    self_contact: bool | None = None
    self_friction: Annotated[float, Field(allow_inf_nan=False, ge=0)] | None = None
    topology_change: bool | None = None
    torsion_ratio: Annotated[float, Field(allow_inf_nan=False, ge=0)] | None = None
    tip_load: TipLoad | None = None


class GroundForm(Form):
    """A horizontal plane."""

    height_m: Number
    friction: Annotated[float, Field(allow_inf_nan=False, ge=0)] | None = None


class GripForm(Form):
    """A rigid gripper."""

    controllers: list[Index]
    region_min_m: Vector | None = None
    region_max_m: Vector | None = None
    points: list[Index] = Field(default_factory=list)
    radius_m: Positive | None = None
    open_s: list[tuple[Number, Number]] = Field(default_factory=list, max_length=1000)


class ColliderForm(Form):
    """A rigid body beside the object."""

    name: Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]
    shape: Literal["sphere", "box", "capsule", "cylinder", "half_space", "mesh"]
    size_m: Size | None = None
    radius_m: Positive | None = None
    length_m: Positive | None = None
    mesh: str | None = None
    friction: Annotated[float, Field(allow_inf_nan=False, ge=0)] | None = None
    position_m: Vector = (0.0, 0.0, 0.0)
    quaternion_wxyz: tuple[Number, Number, Number, Number] = (1.0, 0.0, 0.0, 0.0)
    controllers: list[Index] = Field(default_factory=list)
    poses: str | None = None

    @model_validator(mode="after")
    def _sizes_of_the_shape(self) -> Self:
        needs = {
            "sphere": ("radius_m",), "box": ("size_m",), "capsule": ("radius_m", "length_m"),
            "cylinder": ("radius_m", "length_m"), "half_space": (), "mesh": ("mesh",),
        }[self.shape]  # fmt: skip
        missing = [name for name in needs if getattr(self, name) is None]
        if missing:
            raise ValueError(f"is a {self.shape} without {' and '.join(missing)}")
        return self


class Declaration(Form):
    """``scene.json``."""

    schema_version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=128, pattern=r"^[^/\\\x00-\x1f]+$")]
    kind: Kind
    description: str = ""
    fps: Positive
    gravity_m_s2: Vector
    noise_sigma_m: Number | None = None
    split: Split
    initial_state: Annotated[str, AfterValidator(_known_state)]
    body: BodyForm = Field(default_factory=BodyForm)
    ground: GroundForm | None = None
    grips: list[GripForm] | None = None
    colliders: list[ColliderForm] | None = None
    notes: dict[str, Any] | None = None


def parse_json(text: bytes) -> tuple[dict[str, Any], list[FieldError]]:
    """The object in ``scene.json`` and the faults of its text."""
    where: list[str | int] = ["scene.json"]
    if len(text) > MAX_JSON_BYTES:
        return {}, [FieldError(loc=where, msg=f"has {len(text)} bytes, at most {MAX_JSON_BYTES} are read")]
    values = sum(
        text.count(mark) for mark in (b",", b"[", b"{")
    )  # before anything is parsed; a few more than there are
    if values > MAX_JSON_VALUES:
        return {}, [
            FieldError(loc=where, msg=f"holds about {values} values, at most {MAX_JSON_VALUES} are read")
        ]
    try:
        declared = json.loads(text.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        return {}, [FieldError(loc=where, msg=f"is not UTF-8 text: {error.reason} at byte {error.start}")]
    except json.JSONDecodeError as error:
        fault = f"is not JSON: {error.msg} at line {error.lineno}, column {error.colno}"
        return {}, [FieldError(loc=where, msg=fault)]
    except (RecursionError, ValueError) as error:
        return {}, [FieldError(loc=where, msg=f"cannot be read: {error}")]
    if not isinstance(declared, dict):
        return {}, [FieldError(loc=where, msg=f"holds a {type(declared).__name__}, not an object")]
    if _depth(declared) > MAX_DEPTH:
        return {}, [FieldError(loc=where, msg=f"nests deeper than {MAX_DEPTH} levels")]
    return declared, []


def check_form(declared: dict[str, Any]) -> tuple[Declaration | None, list[FieldError]]:
    """``declared`` as the form, or every fault of it; NaN and infinities are faults wherever they are."""
    faults = [
        FieldError(loc=["scene.json", *path], msg=f"is {value}, which JSON has no word for")
        for path, value in _non_finite(declared, [])
    ]
    try:
        declaration = Declaration.model_validate_json(json.dumps(declared))
    except ValidationError as error:
        named = [fault.loc for fault in faults]
        found = [_field_error(fault) for fault in error.errors(include_url=False, include_context=False)]
        return None, faults + [fault for fault in found if fault.loc not in named]
    unread = {"/".join(path): len(json.dumps(value)) for path, value in _unread(declared, declaration, [])}
    if sum(unread.values()) > MAX_UNREAD_BYTES:
        largest = max(unread, key=lambda path: unread[path])
        message = (
            f"holds {sum(unread.values())} bytes under keys that are not read, at most {MAX_UNREAD_BYTES} are kept; "
            f"the most, {unread[largest]}, under {largest[:80]!r}"
        )
        faults.append(FieldError(loc=["scene.json"], msg=message))
    return (None if faults else declaration), faults


def _unread(given: Any, form: Any, path: list[str]) -> list[tuple[list[str], Any]]:
    """What of a JSON tree no field of the form takes, with where it is; ``notes`` are kept and never read."""
    if isinstance(form, list):
        return [found for item, part in zip(given, form, strict=False) for found in _unread(item, part, path)]
    if not isinstance(form, Form) or not isinstance(given, dict):
        return []
    found = []
    for key, value in given.items():
        if key == "notes" or key not in type(form).model_fields:
            found.append(([*path, key], value))
        else:
            found += _unread(value, getattr(form, key), [*path, key])
    return found


def _field_error(fault: Any) -> FieldError:
    loc: list[str | int] = ["scene.json", *fault["loc"]]
    if fault["type"] == "missing":
        return FieldError(loc=loc, msg="is missing")
    given = repr(fault["input"])
    message = fault["msg"].removeprefix("Value error, ")
    if message.startswith("is "):
        return FieldError(loc=loc, msg=message)
    return FieldError(loc=loc, msg=f"{message[0].lower()}{message[1:]}, not {given[:80]}")


def _depth(value: Any) -> int:
    """Levels of nesting, counted no further than needed to know that they are too many."""
    level, depth = [value], 0
    while level and depth <= MAX_DEPTH:
        level = [
            item
            for outer in level
            if isinstance(outer, dict | list)
            for item in (outer.values() if isinstance(outer, dict) else outer)
        ]
        depth += 1
    return depth


def _non_finite(value: Any, path: list[str | int]) -> list[tuple[list[str | int], float]]:
    """Where NaN and infinities are in a JSON tree."""
    if isinstance(value, float) and not math.isfinite(value):
        return [(path, value)]
    if isinstance(value, dict):
        return [found for key, item in value.items() for found in _non_finite(item, [*path, key])]
    if isinstance(value, list):
        return [found for i, item in enumerate(value) for found in _non_finite(item, [*path, i])]
    return []
