"""The strengths that a published network was trained over: where it stands among them, and how to move it elsewhere.

A network that learned from episodes of varied strengths takes each of them as a column of Φ that the whole body shares
(:attr:`~physworld.worldmodel.model.model.WorldModel.shared_columns`). A version stands at fixed values s of these
columns, folded into one input of its first layers. What a unit of each column adds to that input's weight is kept, so
that the same network can be put at other strengths s':

    W[:, object] += U (s' - s)          U (H, m) of the encoder, (3, m) of the skip connection

Only strengths that the demonstrations varied are here, each with the range that they covered; beyond it nothing was
learned.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from physworld.arrays import Array
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn

ENCODER, SKIP, STANDS = "phi.strengths.encoder", "phi.strengths.skip", "phi.strengths.at"
"""Names of the tensors; readers that do not know them leave out what begins with ``phi``."""


@dataclass(frozen=True, eq=False)
class Conditioning:
    """See the module's text.

    Attributes:
        columns: of the strengths, m of them; ``limits`` are what the demonstrations covered.
        at: where the network stands, values of the columns, (m,).
        encoder, skip: what a unit of each column adds to the weight of the input that is 1 for the object, (H, m) and
            (3, m).
    """

    columns: tuple[PhiColumn, ...]
    at: Array
    encoder: Array
    skip: Array

    @classmethod
    def of(
        cls,
        model: WorldModel,
        at: Mapping[str, float],
        covered: Mapping[str, tuple[float, float]] | None = None,
    ) -> Conditioning | None:
        """Of a network that learned shared columns; None of one that learned none, or that adds nothing to its prior.

        Args:
            model: with its shared columns.
            at: values of the columns at which a version will stand, by name.
            covered: what the demonstrations covered of a strength, in its unit; the column's limits where it says none.

        Raises:
            ValueError: a column without limits.
        """
        covered = covered or {}
        columns = tuple(
            replace(one, limits=(one.column_of(covered[one.name][0]), one.column_of(covered[one.name][1])))
            if one.name in covered
            else one
            for one in model.shared_columns
        )
        if not columns or not model.corrects_prior():
            return None
        if unlimited := [one.name for one in columns if one.limits is None]:
            raise ValueError(f"no limits for the model's columns {', '.join(unlimited)}")
        first = _object_input(model)
        scales = model.norm.properties[len(PROPERTIES) :].numpy(force=True).astype(np.float64)
        rows = (layer.weight.numpy(force=True) for layer in (model.encoder.first, model.skip))
        encoder, skip = (row[:, first : first + len(columns)].astype(np.float64) / scales for row in rows)
        return cls(columns, np.array([at[one.name] for one in columns]), encoder, skip)

    @property
    def names(self) -> list[str]:
        """``effect.strength``, or ``ground.friction``."""
        return [one.name for one in self.columns]

    @property
    def quantities(self) -> dict[str, float]:
        """Where the network stands, in the strengths' units."""
        values = zip(self.columns, self.at.tolist(), strict=True)
        return {one.name: one.quantity_of(value) for one, value in values}

    def range_of(self, column: PhiColumn) -> tuple[float, float]:
        """What the demonstrations covered of a strength, in its unit."""
        assert column.limits is not None
        low, high = (column.quantity_of(end) for end in column.limits)
        return low, high

    def moved(self, model: WorldModel, named: Mapping[str, float]) -> tuple[WorldModel, Conditioning]:
        """The network, which stands here, at other strengths by name in their units, the others as they are.

        Raises:
            ValueError: a name that is none of them, or a strength outside of what was covered.
        """
        at = self.at.copy()
        for name, quantity in named.items():
            if name not in self.names:
                raise ValueError(f"there is no strength {name!r}; there are {', '.join(self.names)}")
            place = self.names.index(name)
            column = self.columns[place]
            low, high = self.range_of(column)
            slack = 1e-6 * (high - low)
            if not low - slack <= quantity <= high + slack:
                raise ValueError(
                    f"{name} is {quantity:g}; the demonstrations covered {low:.6g} to {high:.6g} {column.unit}"
                )
            at[place] = column.column_of(min(max(quantity, low), high))
        other = copy.deepcopy(model)
        first = _object_input(other)
        for layer, unit in ((other.encoder.first, self.encoder), (other.skip, self.skip)):
            _add(layer, first, unit @ (at - self.at))
        return other, Conditioning(self.columns, at, self.encoder, self.skip)

    def to_tensors(self) -> dict[str, Array]:
        """The arrays by their published names, float32."""
        arrays = {ENCODER: self.encoder, SKIP: self.skip, STANDS: self.at}
        return {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in arrays.items()}

    def facts(self) -> list[dict[str, Any]]:
        """The columns, and where the network stands in the strengths' units; JSON types."""
        return [
            {
                "name": one.name,
                "unit": one.unit,
                "logarithmic": one.logarithmic,
                "calibrated": one.calibrated,
                "half_width": one.half_width,
                "range": list(self.range_of(one)),
                "value": self.quantities[one.name],
            }
            for one in self.columns
        ]

    @classmethod
    def read(
        cls, tensors: Mapping[str, Array], facts: Sequence[Mapping[str, Any]] | None
    ) -> Conditioning | None:
        """The inverse of :meth:`to_tensors` and :meth:`facts`; None where a version tells none.

        Raises:
            KeyError: a tensor or a fact is missing.
            ValueError: tensors that do not fit the facts.
        """
        if not facts:
            return None
        columns = []
        for told in facts:
            column = PhiColumn(
                told["name"], told["unit"], told["logarithmic"], True, told["calibrated"], told["half_width"]
            )
            low, high = (column.column_of(end) for end in told["range"])
            columns.append(replace(column, limits=(low, high)))
        encoder, skip, at = (tensors[name].astype(np.float64) for name in (ENCODER, SKIP, STANDS))
        count = len(columns)
        if encoder.ndim != 2 or encoder.shape[1] != count or skip.shape != (3, count) or at.shape != (count,):
            raise ValueError(
                f"{ENCODER} {encoder.shape}, {SKIP} {skip.shape} and {STANDS} {at.shape} of {count} strengths"
            )
        return cls(tuple(columns), at, encoder, skip)


def _object_input(model: WorldModel) -> int:
    """Place of the first input after Φ's properties: shared columns where there are some, then 1 for the object."""
    return 3 * model.config.history + 3 + len(PROPERTIES)


def _add(layer: nn.Linear, place: int, values: Array) -> None:
    with torch.no_grad():
        layer.weight[:, place] += torch.as_tensor(values, dtype=layer.weight.dtype)
