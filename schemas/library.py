"""The catalogue: what this version knows by name, with units, bounds and defaults.

Laws, effects, metrics, importers and export formats are declared in the rooms that implement them. What they say of
themselves is written into ``catalogue.json`` (``python -m scripts.catalogue``), because neither web process nor SDK
loads Warp. Another package that adds to the registries (:mod:`physworld.catalogue`) carries such a file too, written
by ``python -m physworld_workers.commands.catalogue PACKAGE``, and names its top-level package as an entry point::

    [project.entry-points."physworld.catalogue"]
    my_package = "my_package"
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue

from physworld_schemas.base import UNIT_BESIDE, Resource

BodyShape = Literal["solid", "sheet", "rod"]
NameKind = Literal["law", "flow law", "effect"]
FILE = "catalogue.json"


class Quantity(Resource):
    """A number of a law or an effect.

    ``default`` null: it must be given, or the body decides. ``bounds`` by the body's shape, null where there is none:
    of a law what makes sense, of an effect what a search may try on a body of everyday size. ``gate``: of an effect,
    zero switches it off.
    """

    unit: str = Field(description="Unit of the value; `1` has none.", examples=["Pa"])
    help: str = Field(default="", description="What it means, in a sentence.")
    default: float | None = Field(
        default=None,
        description="Value without a choice; null: it must be given, or the body decides.",
        json_schema_extra=UNIT_BESIDE,
    )
    bounds: dict[BodyShape, tuple[float | None, float | None]] = Field(
        default_factory=dict,
        description="Least and greatest value by the body's shape; null: none.",
        json_schema_extra=UNIT_BESIDE,
    )
    gate: bool = Field(default=False, description="Zero switches the effect off.")


class Material(Resource):
    """A constitutive law: an elastic one with its stored energy, or a flow law with its yield condition."""

    name: str = Field(description="Name in requests.")
    kind: Literal["elastic", "flow"] = Field(default="elastic", description="Elastic law or flow law.")
    body: BodyShape = Field(default="solid", description="Shape of body that it is of.")
    title: str = Field(description="Name for people.")
    equation: str = Field(description="Equation, in plain text.")
    use: str = Field(default="", description="What it is for.")
    parameters: dict[str, Quantity] = Field(default_factory=dict, description="Its constants.")


class Effect(Resource):
    """A physical effect: what it adds to the equations, and why a body's shape refuses it where it does."""

    name: str = Field(description="Name in requests.")
    title: str = Field(description="Name for people.")
    kind: str = Field(default="", description="Force, stress, boundary or measurement.")
    equation: str = Field(description="Equation, in plain text.")
    parameters: dict[str, Quantity] = Field(default_factory=dict, description="Its strengths.")
    refused: dict[BodyShape, str] = Field(
        default_factory=dict, description="Shapes of body that refuse it, and why."
    )


class Metric(Resource):
    """How predictions are scored; ``listed`` false: in the tables of means only."""

    name: str = Field(description="Name in results.")
    title: str = Field(description="Name for people.")
    unit: str = Field(description="Unit of the value; `1` has none.", examples=["m"])
    help: str = Field(default="", description="What it means, in a sentence.")
    lower_is_better: bool = Field(default=True, description="Which way is better.")
    listed: bool = Field(default=True, description="Whether tables show it.")


class Importer(Resource):
    """A form of recording: ``POST /v1/scenes`` reads those with suffixes, and the content decides; ``physworld
    import`` all."""

    name: str = Field(description="Name.")
    title: str = Field(description="Name for people.")
    suffixes: list[str] = Field(default_factory=list, description="Usual endings of its files.")
    help: str = Field(default="", description="What it means, in a sentence.")


class ExportFormat(Resource):
    """A form in which the SDK writes the episodes of a dataset."""

    name: str = Field(description="Name in `format`.")
    title: str = Field(description="Name for people.")
    help: str = Field(default="", description="What it means, in a sentence.")


class Catalogue(Resource):
    """Everything that this version knows by name."""

    materials: list[Material] = Field(default_factory=list, description="Constitutive laws.")
    effects: list[Effect] = Field(default_factory=list, description="Effects.")
    metrics: list[Metric] = Field(default_factory=list, description="Metrics.")
    importers: list[Importer] = Field(default_factory=list, description="Forms of recordings.")
    exports: list[ExportFormat] = Field(default_factory=list, description="Forms of export.")

    def listed_metrics(self) -> list[Metric]:
        """The metrics that comparisons, reports and pages show, in their order."""
        return [metric for metric in self.metrics if metric.listed]

    def metric(self, name: str) -> Metric:
        """The metric of that name; of one that is not installed here only the name is known."""
        known = {metric.name: metric for metric in self.metrics}
        return known.get(name, Metric(name=name, title=name, unit="1"))


@cache
def catalogue() -> Catalogue:
    """Our own catalogue and those of the installed packages that add to it."""
    found = Catalogue.model_validate_json((Path(__file__).parent / FILE).read_bytes())
    for point in entry_points(group="physworld.catalogue"):
        more = Catalogue.model_validate_json(file_of(point.value).read_bytes())
        for field in Catalogue.model_fields:
            getattr(found, field).extend(getattr(more, field))
    return found


def file_of(package: str) -> Path:
    """Where a top-level package keeps its catalogue; nothing of the package is run to find out."""
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(
            f"{package} adds to the catalogue but is no installed package with an __init__.py"
        )
    return Path(spec.origin).parent / FILE


def known_names(kind: NameKind) -> list[str]:
    """What a request may call a law, a flow law or an effect."""
    if kind == "effect":
        return [effect.name for effect in catalogue().effects]
    if kind == "flow law":
        return [law.name for law in catalogue().materials if law.kind == "flow"]
    return ["auto", *(law.name for law in catalogue().materials if law.kind == "elastic")]


@dataclass(frozen=True)
class NamesOf:
    """Marks a field of names: OpenAPI lists them, and the API refuses others.

    The models themselves take any name, so that a client reads what a service with more packages has made.
    """

    kind: NameKind

    def __get_pydantic_json_schema__(self, core: Any, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The names as an enumeration."""
        return {**handler(core), "enum": known_names(self.kind)}
