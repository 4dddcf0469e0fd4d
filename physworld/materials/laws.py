"""What every elastic law says of itself, whatever the shape of the body; fields multiply it particle by particle.

Only the ratio of stiffness to density shows in a motion under gravity, ground and prescribed grips; the density is a
prior then, and the stiffness is reported for that density.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from physworld.arrays import Array


@dataclass(frozen=True)
class Law(ABC):
    """Constants of one homogeneous elastic law with its friction.

    Every law says of itself its ``name``, a ``title``, its ``equation`` and its ``use``: what it is for.

    Attributes:
        dimension: 3 of a solid, 2 of a sheet, 1 of a rod.
        friction_name: the constant that is its own friction; 0 where there is none.
        strain_orders: orders of the derivatives along the axes of the lattice that its strains are made of.
    """

    dimension: ClassVar[int]
    name: ClassVar[str]
    title: ClassVar[str]
    equation: ClassVar[str]
    use: ClassVar[str]
    friction_name: ClassVar[str]
    strain_orders: ClassVar[tuple[tuple[int, ...], ...]]

    @property
    @abstractmethod
    def density(self) -> float:
        """Mass per volume, area or length [kg/m**dimension]."""

    @property
    @abstractmethod
    def wave_speed_m_s(self) -> float:
        """Speed of the fastest elastic waves [m/s]."""

    @property
    @abstractmethod
    def columns(self) -> dict[str, float]:
        """The numbers that internal forces are differentiated by, by name: every modulus, the friction last."""

    @property
    @abstractmethod
    def stiffness_columns(self) -> tuple[int, ...]:
        """Places of the columns that a factor on the stiffness multiplies."""

    @property
    @abstractmethod
    def shape(self) -> tuple[tuple[float, ...], ...]:
        """What internal forces depend on beside the columns."""

    @property
    @abstractmethod
    def friction_law(self) -> Law | None:
        """The elastic law whose linear stiffness is the friction (force per velocity); None without friction."""

    @abstractmethod
    def contact_stiffness(self, cell_m: float) -> tuple[float, float]:
        """Stiffness of a contact across and along its surface [Pa/m] in cells of ``cell_m``."""

    @abstractmethod
    def energy_of(self, derivatives: Array) -> Array:
        """Stored energy [J/m**dimension], (...), without the stiffness field's factor.

        Args:
            derivatives: of the displacement of a solid, of the position of a thin body, by
                :attr:`strain_orders`, (..., k, 3).
        """

    @property
    def torsion_n_m2(self) -> float:
        """GJ, torsional stiffness of a rod [N m^2]; 0 of all other bodies."""
        return 0.0

    @property
    def friction(self) -> float:
        """The constant called :attr:`friction_name`."""
        return float(getattr(self, self.friction_name))

    def without_friction(self) -> Self:
        """The law with its own friction off."""
        return replace(self, **{self.friction_name: 0.0})
