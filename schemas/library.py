"""The catalogue: what this version knows by name, with units, bounds and defaults.

Laws, effects, metrics, importers and export formats are declared in the rooms that implement them. What they say of
themselves is written into ``catalogue.json`` (``python -m scripts.catalogue``), because neither the web process nor the
SDK loads Warp. Another package that adds to the registries (:mod:`physworld.catalogue`) carries such a file too, written
by ``python -m physworld_workers.commands.catalogue PACKAGE``, and names its top-level package as an entry point::

    [project.entry-points."physworld.catalogue"]
    my_package = "my_package"
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue

from physworld_schemas.base import Resource

BodyShape = Literal["solid", "sheet", "rod"]
FILE = "catalogue.json"


class Quantity(Resource):
    """A number of a law or an effect.

    ``default`` null: it must be given, or the body decides. ``bounds`` by the body's shape, null where there is none:
    of a law what makes sense, of an effect what a search may try on a body of everyday size. ``gate``: of an effect,
    zero switches it off.
    """

    unit: str
    help: str = ""
    default: float | None = None
    bounds: dict[BodyShape, tuple[float | None, float | None]] = Field(default_factory=dict)
    gate: bool = False


class Material(Resource):
    """A constitutive law: an elastic one with its stored energy, or a flow law with its yield condition."""

    name: str
    kind: Literal["elastic", "flow"] = "elastic"
    body: BodyShape = "solid"
    title: str
    equation: str
    use: str = ""
    parameters: dict[str, Quantity] = Field(default_factory=dict)


class Effect(Resource):
    """A physical effect: what it adds to the equations, and why a body's shape refuses it where it does."""

    name: str
    title: str
    kind: str = ""
    equation: str
    parameters: dict[str, Quantity] = Field(default_factory=dict)
    refused: dict[BodyShape, str] = Field(default_factory=dict)


class Metric(Resource):
    """How predictions are scored; ``listed`` false: in the tables of means only."""

    name: str
    title: str
    unit: str
    help: str = ""
    lower_is_better: bool = True
    listed: bool = True


class Importer(Resource):
    """A form of recording that ``POST /v1/scenes`` reads; the content decides, not the suffix."""

    name: str
    title: str
    suffixes: list[str] = Field(default_factory=list)
    help: str = ""


class ExportFormat(Resource):
    """A form in which the SDK writes the episodes of a dataset."""

    name: str
    title: str
    help: str = ""


class Catalogue(Resource):
    """Everything that this version knows by name."""

    materials: list[Material] = Field(default_factory=list)
    effects: list[Effect] = Field(default_factory=list)
    metrics: list[Metric] = Field(default_factory=list)
    importers: list[Importer] = Field(default_factory=list)
    exports: list[ExportFormat] = Field(default_factory=list)

    def laws(self, kind: Literal["elastic", "flow"]) -> list[str]:
        """Names of the laws of one kind."""
        return [material.name for material in self.materials if material.kind == kind]

    def listed_metrics(self) -> list[Metric]:
        """The metrics that comparisons, reports and pages show, in their order."""
        return [metric for metric in self.metrics if metric.listed]


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
        raise ModuleNotFoundError(f"{package} adds to the catalogue but is no installed package with an __init__.py")
    return Path(spec.origin).parent / FILE


class NamesOf:
    """Marks a field whose values are names of the catalogue: OpenAPI lists them, and the API refuses others.

    A model does not refuse them itself, so that a client reads what a service with more packages has made.
    """

    def __init__(self, kind: Literal["elastic", "flow", "effects"]) -> None:
        self.kind: Literal["elastic", "flow", "effects"] = kind

    def names(self) -> list[str]:
        """Every name that may stand there."""
        if self.kind == "effects":
            return [effect.name for effect in catalogue().effects]
        return [*(["auto"] if self.kind == "elastic" else []), *catalogue().laws(self.kind)]

    def __get_pydantic_json_schema__(self, core: Any, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The names as an enumeration."""
        return {**handler(core), "enum": self.names()}
