"""The columns of Φ: what each of them stands for, by name.

Φ (n, columns) holds for every object vertex how its material differs from the calibrated twin's. The first columns are
``PROPERTIES``, fields over the body, which priors and kernels read in this order. While a network learns there may be
more, one number each for the whole body: the ground's friction and strengths of effects (``shared``). A card lists the
columns of its version (``architecture.phi``); versions without such a list have ``PROPERTIES``. NumPy only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physworld.arrays import Array

STIFFNESS, DENSITY, FRICTION = "stiffness", "density", "ground.friction"
EPISODE_FIELDS = (STIFFNESS, DENSITY, FRICTION)
"""Columns of an episode's ``properties``, logarithms of ratios; the third where the friction was perturbed by place."""


@dataclass(frozen=True)
class PhiColumn:
    """One column of Φ.

    Attributes:
        name: unique within a model.
        unit: SI unit of the quantity.
        logarithmic: whether the column is log(quantity / calibrated), else (quantity - calibrated) / ``half_width``.
        shared: whether it is one number for the whole body.
        calibrated: the quantity where the column is 0; None for a field that differs from vertex to vertex.
        half_width: of the quantity's interval; 1 of logarithmic columns.
        limits: smallest and largest value of the column that fine-tuning may choose, or None.
    """

    name: str
    unit: str = ""
    logarithmic: bool = True
    shared: bool = False
    calibrated: float | None = None
    half_width: float = 1.0
    limits: tuple[float, float] | None = None

    def column_of(self, quantity: float) -> float:
        """The column's value for a quantity in its unit."""
        base = self._base()
        return float(np.log(quantity / base)) if self.logarithmic else (quantity - base) / self.half_width

    def quantity_of(self, value: float) -> float:
        """The quantity for a value of the column."""
        base = self._base()
        return base * float(np.exp(value)) if self.logarithmic else base + self.half_width * value

    def described(self, prior_spread: float) -> dict[str, Any]:
        """The column as a card tells it; ``prior_spread``: root mean square over the training episodes."""
        return {
            "name": self.name,
            "unit": self.unit,
            "logarithmic": self.logarithmic,
            "shared": self.shared,
            "prior_spread": prior_spread,
        }

    def _base(self) -> float:
        if self.calibrated is None:
            raise ValueError(f"Φ's column {self.name!r} has no single calibrated value")
        return self.calibrated


PROPERTIES = (PhiColumn(STIFFNESS, "Pa"), PhiColumn(DENSITY, "kg/m^3"))


def columns_of(described: Sequence[Mapping[str, Any]] | None) -> tuple[PhiColumn, ...]:
    """The columns that a card lists; ``PROPERTIES`` where it lists none. Raises ValueError for others or another order:
    priors and kernels read the first columns by their place."""
    if described is None:
        return PROPERTIES
    columns = tuple(
        PhiColumn(one["name"], one["unit"], one["logarithmic"], one["shared"]) for one in described
    )
    if columns != PROPERTIES:
        raise ValueError(
            f"Φ has the columns {', '.join(repr(one.name) for one in columns)}; a version has "
            f"{', '.join(repr(one.name) for one in PROPERTIES)}"
        )
    return columns


def with_named(columns: Sequence[PhiColumn], phi: Array, named: Mapping[str, float | Array]) -> Array:
    """Φ (…, n, columns) with some columns replaced by name, each by a number or by (…, n).

    Raises ValueError for a name that is no column.
    """
    names = [one.name for one in columns]
    changed = np.array(phi, dtype=np.float64)
    for name, values in named.items():
        if name not in names:
            raise ValueError(f"Φ has no column {name!r}; it has {', '.join(names)}")
        changed[..., names.index(name)] = values
    return changed
