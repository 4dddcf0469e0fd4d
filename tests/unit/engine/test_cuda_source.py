"""The CUDA text of every law of solids compiles (no GPU is needed for that); what it computes is tested where a GPU is.

The modules of kernels that are not made once a law: ``test_cuda_source_everywhere``.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import warp as wp

from physworld.engine.gradients.solid_tangent_kernels import solid_tangent
from physworld.engine.total.solid_kernels import solid_forces
from physworld.materials.library import SOLID_LAWS

pytestmark = pytest.mark.slow  # CUDA's compiler


def compiles(module: object, folder: Path) -> bool:
    wp.init()
    wp.compile_aot_module(module, arch=80, module_dir=str(folder), use_ptx=True)
    return bool(list(folder.glob("*.ptx")))


@pytest.mark.parametrize("name", sorted({law.stress.name for law in SOLID_LAWS.values()}))
def test_the_kernels_of_every_stress_of_solids_compile_for_cuda(name: str, tmp_path: Path) -> None:
    law = SOLID_LAWS[name](1e5)
    assert compiles(solid_forces(law.stress, len(law.moduli)).module, tmp_path)
    assert compiles(solid_tangent(law.stress, len(law.moduli)).module, tmp_path / "tangent")
