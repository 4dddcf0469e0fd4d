"""Stress of particles in the updated Lagrangian form: a solid's law, and the plastic flow that it may have."""

from __future__ import annotations

import numpy as np
import warp as wp

from physworld.materials.laws import SolidLaw
from physworld.materials.plastic import Plasticity
from physworld.mpm.elastic_stress_kernels import neo_hookean_stress
from physworld.mpm.hencky_kernels import plastic_kernel


class ParticleStress:
    """Turns trial deformation gradients into elastic ones and volume times Kirchhoff stress.

    Args:
        law: elastic constants and friction.
        plasticity: return mapping in Hencky strain, or None for the law's own elastic energy.
        volume: undeformed volume of every particle [m^3], (P,).
        stiffness_factor: factor on stiffness and friction, (P,).
        device: Warp device.
    """

    def __init__(
        self,
        law: SolidLaw,
        plasticity: Plasticity | None,
        volume: np.ndarray,
        stiffness_factor: np.ndarray,
        device: str,
    ) -> None:
        mu, lam = law.lame
        self._device = device
        self._count = len(volume)
        self._plasticity = plasticity
        self._model = [
            wp.array(values.astype(np.float32), dtype=wp.float32, device=device)
            for values in (
                mu * stiffness_factor,
                lam * stiffness_factor,
                volume,
                law.viscosity_pa_s * volume * stiffness_factor,
            )
        ]
        start = 0.0 if plasticity is None else plasticity.initial_memory
        self.memory = wp.full(self._count, wp.float64(start), dtype=wp.float64, device=device)

    def launch(self, F: wp.array, C: wp.array, stress: wp.array, clock: wp.array, flags: wp.array) -> None:
        """Map ``F`` (P mat33d, in place) and write ``stress`` (6P,) [J]; ``C`` (9P,) [1/s] feeds the friction."""
        if self._plasticity is None:
            flat = wp.array(ptr=F.ptr, dtype=wp.float64, shape=9 * self._count, device=self._device)
            inputs, outputs = [*self._model, C, flat], [stress, flags]
            kernel = neo_hookean_stress
        else:
            parameters = wp.vec3d(*self._plasticity.parameters())
            inputs, outputs = [*self._model, parameters, clock, C, F, self.memory], [stress, flags]
            kernel = plastic_kernel(type(self._plasticity).project)
        wp.launch(kernel, dim=self._count, inputs=inputs, outputs=outputs, device=self._device)
