"""The kernels' CUDA text compiles (no GPU is needed for that); what it computes is tested where a GPU is."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import warp as wp


@pytest.mark.parametrize("name", ["solid_kernels", "sheet_kernels", "rod_kernels", "node_kernels"])
def test_the_kernels_compile_for_cuda(name: str, tmp_path: Path) -> None:
    wp.init()
    wp.compile_aot_module(
        import_module(f"physworld.mpm.{name}"), arch=80, module_dir=str(tmp_path), use_ptx=True
    )
    assert list(tmp_path.glob("*.ptx"))
