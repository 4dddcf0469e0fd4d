"""Stress of particles in the updated Lagrangian form: a solid's law, and the plastic flow that it may have."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.updated.elastic_stress_kernels import elastic_stress
from physworld.engine.updated.hencky_kernels import eigen_type, plastic_kernel, stretch
from physworld.materials.plastic import Plasticity
from physworld.materials.solid import SolidLaw

LANES = 8  # particles that an elastic kernel takes at once: arrays are padded to a multiple


def padded(count: int) -> int:
    """Length of the particles' arrays for ``count`` particles."""
    return -(-count // LANES) * LANES


class ParticleStress:
    """Advances deformation gradients, lets them flow, and gives volume times Kirchhoff stress.

    Args:
        law: elastic constants and friction.
        plasticity: return mapping in Hencky strain with the law's mu and lambda, or None for the law's own stress.
        volume: undeformed volume of every particle [m^3], (P,).
        stiffness_factor: factor on stiffness and friction, (P,).
        device: Warp device.

    Attributes:
        ratio: volume ratio of the elastic deformation, (P padded,) float32, as of the last launch.
        memory: the plastic law's scalar, (P,) float64.
    """

    def __init__(
        self,
        law: SolidLaw,
        plasticity: Plasticity | None,
        volume: Array,
        stiffness_factor: Array,
        device: str,
    ) -> None:
        self._device = device
        self._count = len(volume)
        self._plasticity = plasticity

        def array(values: Any) -> wp.array:
            return wp.array(np.asarray(values, dtype=np.float32).reshape(-1), dtype=wp.float32, device=device)

        measure = np.zeros(padded(self._count))
        measure[: self._count] = volume * stiffness_factor
        friction = array(law.viscosity_pa_s * measure)
        self.ratio = wp.full(len(measure), 1.0, dtype=wp.float32, device=device)
        start = 0.0 if plasticity is None else plasticity.initial_memory
        self.memory = wp.full(self._count, wp.float64(start), dtype=wp.float64, device=device)
        if plasticity is None:
            moduli = measure.reshape(-1, 1, LANES) * np.array(law.moduli)[:, None]
            self._model = [array(moduli), friction, array([*law.numbers, 0.0])]
            self._kernel = elastic_stress(law.stress, len(law.moduli))
        else:
            mu, lam = law.lame
            self._model = [
                array(mu * stiffness_factor), array(lam * stiffness_factor), array(volume), friction,
                wp.vec3d(*plasticity.parameters()),
            ]  # fmt: skip
            self._kernel = plastic_kernel(type(plasticity).project)
            self._eigen = wp.zeros(len(measure), dtype=eigen_type, device=device)

    def launch(self, F: wp.array, C: wp.array, stress: wp.array, clock: wp.array, flags: wp.array) -> None:
        """Advance the deformation by a substep and write the stress.

        Args:
            F: elastic deformation gradients, (P padded,) mat33d; changed.
            C: velocity gradients [1/s], (9P padded,).
            stress: volume times Kirchhoff stress [J], (6P padded,); written.
            clock: (frame interval [s], 1/dt [1/s], dt [s]).
            flags: counts of particles that inverted or are not finite, (4,) int32.
        """
        outputs = [stress, self.ratio, flags]
        flat = wp.array(ptr=F.ptr, dtype=wp.float64, shape=9 * len(F), device=self._device)
        if self._plasticity is None:
            dim, inputs = len(F) // LANES, [*self._model, clock, C, flat]
        else:
            groups = len(F) // LANES
            wp.launch(stretch, groups, inputs=[clock, C, flat], outputs=[self._eigen], device=self._device)
            dim, inputs = self._count, [*self._model, clock, C, self._eigen, F, self.memory]
        wp.launch(self._kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)
