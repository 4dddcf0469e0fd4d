"""The CUDA text of the particles' stresses, made once a law or a model, compiles (no GPU is needed for that)."""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from physworld.effects import plasticity, strain_stiffening
from physworld.engine.updated.elastic_stress_kernels import elastic_stress
from physworld.engine.updated.hencky_kernels import plastic_kernel
from physworld.engine.updated.stress_kernels import particle_model
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.plastic import PLASTICITIES

pytestmark = pytest.mark.slow


def compiled(module: object, folder: Path) -> bool:
    wp.compile_aot_module(module, arch=80, module_dir=str(folder), use_ptx=True)
    return bool(list(folder.glob("*.ptx")))


def test_the_stresses_compile_for_cuda(tmp_path: Path) -> None:
    wp.init()
    law = NeoHookean(1e5)
    assert compiled(elastic_stress(law.stress, len(law.moduli)).module, tmp_path)


@pytest.mark.parametrize("name", sorted(PLASTICITIES))
def test_the_return_mappings_compile_for_cuda(name: str, tmp_path: Path) -> None:
    wp.init()
    assert compiled(plastic_kernel(PLASTICITIES[name].project).module, tmp_path)


def test_the_stresses_of_effects_compile_for_cuda(tmp_path: Path) -> None:
    wp.init()
    texts = [strain_stiffening._MODELS[3].text, plasticity._MODELS[3].text]
    for number, text in enumerate(texts):
        assert compiled(particle_model(text).module, tmp_path / str(number))
