"""Every kernel of the library compiles for CUDA, or is named here as native to the CPU (no GPU is needed for that).

Kernels are found by importing the library, so that a new one is held to the same. What is made once a law or a model is
compiled for each of them; ``test_cuda_source`` and ``test_updated_lagrangian_cuda_source`` have the laws of solids.
"""

from __future__ import annotations

import pkgutil
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import torch
import warp as wp
from warp._src import context

import physworld
from physworld.engine.gradients import adjoint_kernels, adjoint_stages_kernels
from physworld.engine.gradients.adjoint_stress_kernels import stress_adjoint
from physworld.engine.total.stress_kernels import StressModel
from physworld.materials.plastic import PLASTICITIES
from physworld.worldmodel.native.messages import EdgeList, mean_messages, mean_messages_torch

pytestmark = pytest.mark.slow  # CUDA's compiler, over a hundred kernels

ARCHITECTURE = 80
CPU_ONLY = {  # rows of SIMD registers; on other devices torch does the same (``messages``, ``chain_step``)
    "physworld.worldmodel.native.chain_kernels",
    "physworld.worldmodel.native.engine_kernels",
    "physworld.worldmodel.native.message_kernels",
    "physworld.worldmodel.native.nearest_kernels",
}


@pytest.fixture(scope="module", autouse=True)
def compiler() -> None:
    wp.init()
    if not context.runtime.nvrtc_supported_archs:
        pytest.skip("this build of Warp has no NVRTC: CUDA text cannot be compiled here")


def compiles(module: object, folder: Path) -> bool:
    wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=str(folder), use_ptx=True)
    texts = list(folder.glob("*.ptx"))
    return bool(texts) and all(".entry" in text.read_text() for text in texts)


@cache
def library() -> dict[str, ModuleType]:
    return {
        found.name: import_module(found.name)
        for found in pkgutil.walk_packages(physworld.__path__, "physworld.")
        if not found.name.endswith("__main__")
    }


def with_kernels() -> list[str]:
    """Modules of the library that define kernels of their own, found by their text."""
    root = Path(physworld.__file__).parent
    names = []
    for path in sorted(root.rglob("*.py")):
        if any(
            line.startswith("@wp.kernel") and "module=" not in line for line in path.read_text().splitlines()
        ):
            names.append(".".join(("physworld", *path.relative_to(root).with_suffix("").parts)))
    return names


def models() -> dict[str, StressModel]:
    """Stresses that effects add, by module and dimension."""
    return {
        f"{name.rpartition('.')[2]}-{dimension}": model
        for name, module in library().items()
        if name.startswith("physworld.effects.")
        for dimension, model in getattr(module, "_MODELS", {}).items()
        if isinstance(model, StressModel)
    }


@pytest.mark.parametrize("name", [name for name in with_kernels() if name not in CPU_ONLY])
def test_a_module_of_kernels_compiles_for_cuda(name: str, tmp_path: Path) -> None:
    module = import_module(name)
    if module in (adjoint_kernels, adjoint_stages_kernels):
        _overload_generic_kernels()
    assert compiles(module, tmp_path)


def _overload_generic_kernels() -> None:
    """Histories of the adjoint are kept in double or single precision, memories too."""
    for real in (wp.float32, wp.float64):
        for kernel, generic in (
            (adjoint_kernels.keep_row, {"history": wp.array2d(dtype=real)}),
            (adjoint_kernels.keep_rows, {"memory": wp.array(dtype=real)}),
            (adjoint_kernels.load_row, {"memory": wp.array(dtype=real)}),
            (adjoint_kernels.last_positions, {"history": wp.array2d(dtype=real)}),
            (adjoint_kernels.take_nodes_back, {"history": wp.array2d(dtype=real)}),
            (
                adjoint_stages_kernels.enter_stages_back,
                {"history": wp.array2d(dtype=real), "forces": wp.array2d(dtype=real)},
            ),
            (
                adjoint_kernels.add_memory_work,
                {"high": wp.array(dtype=real), "low": wp.array(dtype=real)},
            ),
        ):
            wp.overload(kernel, generic)


@pytest.mark.parametrize("name", sorted(models()))
def test_the_stress_of_an_effect_compiles_for_cuda(name: str, tmp_path: Path) -> None:
    model = models()[name]
    assert compiles(model.kernel.module, tmp_path)
    if model.dim == 3:
        assert compiles(stress_adjoint(model).module, tmp_path / "adjoint")


HOST_WRITES = {  # arrays that lie on the CPU whatever the device of the simulation
    "engine/total/formulation.py": {"clock", "counter"},
    "baselines/spring_steps.py": {"_path", "grad", "_met"},
}


def test_nothing_is_written_into_a_copy_on_the_host() -> None:
    """``array.numpy()[…] = …`` changes an array of the CPU and no other: a gradient was wrong on CUDA for it."""
    root, found = Path(physworld.__file__).parent, {}
    for path in root.rglob("*.py"):
        written = set(re.findall(r"(\w+)\.numpy\(\)\[[^\]]*\] *[-+*/]?=[^=]", path.read_text()))
        written |= set(re.findall(r"np\.\w+\.at\([^,]*?(\w+)\.numpy\(\),", path.read_text()))
        if written:
            found[str(path.relative_to(root))] = written
    assert found == HOST_WRITES


def test_the_lists_are_complete() -> None:
    names = with_kernels()
    assert set(names) >= CPU_ONLY
    assert "physworld.video.render_kernels" in names
    assert len(names) >= 25 and len(models()) >= 10 and PLASTICITIES


def test_what_is_native_to_the_cpu_has_a_way_elsewhere() -> None:
    """On a device without data ("meta") the torch form is taken, and no tensor of the CPU gets into it."""
    edges = EdgeList(*(torch.tensor(x, dtype=torch.int32) for x in ([0, 1, 2], [1, 0], [0, 1])), order=None)
    shapes = ((1, 2, 3, 16), (1, 2, 3, 16), (2, 16), (2, 3), (1, 16))
    here = [torch.randn(shape) for shape in shapes]
    assert torch.allclose(mean_messages(edges, *here), mean_messages_torch(edges, *here), atol=1e-5)
    away = [torch.empty(shape, device="meta") for shape in shapes]
    assert mean_messages(edges, *away).shape == (1, 2, 3, 16)
