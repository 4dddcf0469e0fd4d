"""``python -m physworld_workers.commands.catalogue PACKAGE``: write what a package adds to the registries.

The file, ``catalogue.json`` in the package's folder, is what API, dashboard, SDK and command line show of its laws,
effects and metrics (:mod:`physworld_schemas.library`); they load neither Warp nor the package. Our own is written by
``python -m scripts.catalogue``, which also knows the formats of the SDK.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from physworld.catalogue import quantities
from physworld_schemas.library import (
    BodyShape,
    Catalogue,
    Effect,
    Importer,
    Material,
    Metric,
    Quantity,
    file_of,
)

if TYPE_CHECKING:
    from physworld.effects.base import Effect as EffectClass
    from physworld.twin.twin import Twin

OWN = "physworld"
SHAPES: dict[int, BodyShape] = {3: "solid", 2: "sheet", 1: "rod"}
_DIGITS = 3  # of bounds that follow a body of everyday size
_PARTICLES = 300  # bounds do not depend on the resolution, except for a grip's and a clamp's, by the cell


def main(arguments: list[str] | None = None) -> int:
    """Write the file of one package."""
    parser = argparse.ArgumentParser(
        prog="python -m physworld_workers.commands.catalogue",
        description="Write PACKAGE/catalogue.json: the laws, effects and metrics that it registers.",
    )
    parser.add_argument("package", help="an installed top-level package")
    given = parser.parse_args(arguments)
    path = file_of(given.package)
    path.write_text(as_json(registered(given.package)), encoding="utf-8")
    print(path)
    return 0


def registered(package: str = OWN) -> Catalogue:
    """What the modules of one top-level package have in the registries; our importers are of ours."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # before the first import that starts it
    from physworld.effects.registry import EFFECTS
    from physworld.evaluate.metrics import metrics
    from physworld.materials.library import ELASTIC_LAWS
    from physworld.materials.plastic import PLASTICITIES
    from physworld.twin.build import build_twin
    from physworld_scenes.importers import FOLDERS, IMPORTERS
    from physworld_workers.commands.effects import everyday_scenes

    def own(thing: Any) -> bool:
        return bool(thing.__module__.split(".")[0] == package)

    everyday = everyday_scenes()
    twins = {shape: build_twin(everyday[shape], _PARTICLES) for shape in SHAPES.values()}
    laws = [_material(law, "elastic", SHAPES[law.dimension]) for law in ELASTIC_LAWS.values() if own(law)]
    flows = [_material(law, "flow", "solid") for law in PLASTICITIES.values() if own(law)]
    return Catalogue(
        materials=laws + flows,
        effects=[_effect(kind, twins) for kind in EFFECTS.values() if own(kind)],
        metrics=[_described(Metric, metric) for metric in metrics().values() if own(metric.per_frame)],
        importers=[_described(Importer, importer) for importer in (*IMPORTERS, *FOLDERS) if package == OWN],
    )


def as_json(found: Catalogue) -> str:
    """The catalogue as its file has it."""
    text = json.dumps(found.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"
    return re.sub(
        r"\[([^][{}\"]*)\]", lambda pair: f"[{' '.join(pair[1].split())}]", text
    )  # bounds on one line


def _material(law: Any, kind: Literal["elastic", "flow"], body: BodyShape) -> Material:
    """What an elastic or a flow law says of itself."""
    defaults = {field.name: field.default for field in fields(law)}
    return Material(
        name=law.name,
        kind=kind,
        body=body,
        title=law.title,
        equation=law.equation,
        use=law.use,
        parameters={
            name: Quantity(
                unit=quantity.unit,
                help=quantity.help,
                default=_number(defaults[name]),
                bounds={body: (quantity.low, quantity.high)},
            )
            for name, quantity in quantities(law).items()
        },
    )


def _effect(kind: type[EffectClass], twins: dict[BodyShape, Twin]) -> Effect:
    """What an effect says of itself, with the bounds of its strengths on each body."""
    defaults = kind().values
    refused = {shape: reason for shape, twin in twins.items() if (reason := kind.refuses(twin)) is not None}
    parameters: dict[str, Quantity] = {}
    for shape, twin in twins.items():
        for strength in () if shape in refused else kind.strengths(twin):
            known = parameters.setdefault(
                strength.name,
                Quantity(unit=strength.unit, default=_number(defaults[strength.name]), gate=strength.gate),
            )
            known.bounds[shape] = (_rounded(strength.low), _rounded(strength.high))
    return Effect(
        name=kind.name,
        title=kind.title,
        kind=kind.kind,
        equation=kind.equation,
        parameters=parameters,
        refused=refused,
    )


def _described(form: Any, entry: Any) -> Any:
    """The wire's form of an entry, its fields of the same name."""
    return form(**{name: getattr(entry, name) for name in form.model_fields})


def _number(value: Any) -> float | None:
    """A default as JSON has it: null for none and for what is infinite."""
    return float(value) if isinstance(value, float | int) and math.isfinite(value) else None


def _rounded(value: float) -> float:
    return float(f"{np.float64(value):.{_DIGITS}g}")


if __name__ == "__main__":
    sys.exit(main())
