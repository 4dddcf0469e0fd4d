"""The chain prior on a CPU: its arrays as ``chain_kernels`` takes them, its differentiable flow, and whole rollouts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.worldmodel.native.messages import warp_module
from physworld.worldmodel.priors.chain import CALMINGS, ChainPrior

ROW = 16


def chain_sizes(prior: ChainPrior, history: int) -> dict[str, int]:
    """The kernel's sizes."""
    return {
        "chain_nodes": len(prior.mass),
        "chain_width": -(-len(prior.mass) // ROW) * ROW,
        "chain_groups": len(prior.markers),
        "chain_substeps": prior.substeps,
        "chain_calms": CALMINGS if _calms(prior) else 0,
        "chain_lags": min(history, 2) + 1,
        "chain_curved": int(np.any(prior.natural)),
    }


def chain_arrays(prior: ChainPrior) -> dict[str, Array]:
    """The kernel's arrays, float32, nodes padded to whole rows; ``chain_scratch`` is each caller's own."""
    count = len(prior.mass)
    width = -(-count // ROW) * ROW

    def padded(values: Array) -> Array:
        out = np.zeros((*values.shape[:-1], width), dtype=np.float32)
        out[..., : values.shape[-1]] = values
        return out

    free = (prior.member.sum(axis=1) == 0).astype(float)
    rows = np.arange(count - 2)
    share = np.zeros((width, prior.share.shape[1]))
    share[:count] = prior.share
    arrays = {
        "spread": padded(prior.spread),
        "read": padded(prior.read.T),
        "hold": padded(prior.hold.T),
        "length": padded(prior.length),
        "pull": padded(prior.pull),
        "lightness": padded(free / prior.mass),
        "curve": padded(np.stack([prior.curve[rows, rows + k] for k in range(3)])),
        "bend": padded(prior.bend),
        "keep": padded(prior.keep.T),
        "calm": padded(prior.calm.T),
        "calm_back": padded(prior.calm),
        "smooth": padded(prior.smooth.T),
        "slack": padded(prior.slack.T),
        "dash": padded(prior.dash * prior.substeps),
        "free": padded(free),
        "share": share,
    }
    plain = (
        "member", "offset", "anchor", "first", "second", "axis", "markers", "reach", "gravity", "natural", "carry",
        "normal", "twist", "between",
    )  # fmt: skip
    arrays |= {name: getattr(prior, name) for name in plain}
    return {f"chain_{name}": np.ascontiguousarray(value, dtype=np.float32) for name, value in arrays.items()}


def chain_scratch(width: int) -> Array:
    """Working memory of one call."""
    return np.zeros((_kernels().SCRATCH_ROWS, width + 2 * ROW), dtype=np.float32)


def _calms(prior: ChainPrior) -> bool:
    """Whether ``calm`` does anything in single precision."""
    return bool(np.any(prior.calm.astype(np.float32) != np.eye(len(prior.calm), dtype=np.float32)))


class ChainRoller:
    """Whole rollouts of the prior alone."""

    def __init__(self, prior: ChainPrior, history: int) -> None:
        self._sizes, self._arrays = chain_sizes(prior, history), chain_arrays(prior)
        self._history = history

    def run(self, start: Array, driven: Array, logs: Array) -> Array:
        """Vertices (B, T, V, 3) float32 of object frames (B, h+1, n, 3), control vertices (B, T, C, 3), Φ (B, n, 2)."""
        count, frames, controls = driven.shape[:3]
        n = start.shape[2]
        path = np.zeros((count, frames, n + controls, 3), dtype=np.float32)
        path[:, : self._history + 1, :n] = start
        path[:, :, n:] = driven
        sizes = self._sizes | {
            "candidates": count,
            "frames": frames,
            "objects": n,
            "vertices": n + controls,
            "controls": controls,
            "first": self._history,
        }
        arrays = self._arrays | {
            "chain_scratch": chain_scratch(self._sizes["chain_width"]),
            "paths": path,
            "logs": np.ascontiguousarray(logs, dtype=np.float32),
        }
        kernels = _kernels()
        names = (*kernels.CHAIN_SIZES, *kernels.ROLL_SIZES)
        table = (*kernels.CHAIN_ARRAYS, *kernels.ROLL_ARRAYS)
        _launch(kernels.chain_roll, [sizes[n] for n in names], [arrays[n].ctypes.data for n in table])
        return path


class NativeFlow:
    """The flow of one prior over a tick, differentiable by start, velocity, moduli and push."""

    def __init__(self, prior: ChainPrior, history: int) -> None:
        self.sizes, self.arrays = chain_sizes(prior, history), chain_arrays(prior)

    def __call__(self, *tensors: Tensor) -> Tensor:
        """Places (K, M, 3) after a tick, of the arguments of :meth:`ChainStep.flow`."""
        return _flow(self, *tensors)

    def launch(self, count: int, given: dict[str, Array], back: bool) -> None:
        """One call of the kernel."""
        kernels = _kernels()
        sizes = [self.sizes[name] for name in kernels.CHAIN_SIZES] + [count, int(back)]
        arrays = self.arrays | {"chain_scratch": chain_scratch(self.sizes["chain_width"])} | given
        names = (*kernels.CHAIN_ARRAYS, *kernels.FLOW_ARRAYS)
        _launch(
            kernels.chain_flow, sizes, [arrays[name].ctypes.data if name in arrays else 0 for name in names]
        )

    def rows(self, values: Tensor) -> Array:
        """(K', M, 3 or 1) as padded rows (M, 3, W) or (M, W)."""
        count, many, axes = values.shape
        out = np.zeros((many, axes, self.sizes["chain_width"] + 2 * ROW), dtype=np.float32)
        out[:, :, ROW : ROW + count] = values.detach().permute(1, 2, 0).numpy()
        return out if axes == 3 else out[:, 0]

    def tensor(self, rows: Array, like: Tensor) -> Tensor:
        """The inverse of :meth:`rows`."""
        whole = rows if rows.ndim == 3 else rows[:, None]
        return torch.from_numpy(whole[:, :, ROW : ROW + like.shape[0]]).permute(2, 0, 1)


class _Flow(torch.autograd.Function):
    """Native forward and adjoint; keeps the places at every substep."""

    @staticmethod
    def forward(ctx: Any, native: NativeFlow, *tensors: Tensor) -> Tensor:
        names = ("places", "velocities", "heres", "slopes", "turns", "pulls", "bends", "eases", "pushes")
        given = {name: native.rows(value) for name, value in zip(names, tensors, strict=True)}
        many = tensors[0].shape[1]
        wanted = any(ctx.needs_input_grad)
        if wanted:
            width = native.sizes["chain_width"] + 2 * ROW
            ctx.trace = np.empty((many, native.sizes["chain_substeps"], 3, width), dtype=np.float32)
            given["traces"] = ctx.trace
        moduli = {name: given[name] for name in names[5:]}
        native.launch(many, given, back=False)
        if wanted:
            ctx.native, ctx.moduli = native, moduli
            ctx.shapes = [value.shape for value in tensors]
        return native.tensor(given["places"], tensors[0])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        native, many = ctx.native, grad.shape[1]
        given = {"places": native.rows(grad), "traces": ctx.trace, **ctx.moduli}
        for name in ("by_velocities", "by_pushes"):
            given[name] = np.zeros_like(given["places"])
        for name in ("by_pulls", "by_bends", "by_eases"):
            given[name] = np.zeros_like(ctx.moduli["pulls"])
        native.launch(many, given, back=True)
        like = [torch.empty(shape, device="meta") for shape in ctx.shapes]
        return (
            None,
            native.tensor(given["places"], like[0]),
            native.tensor(given["by_velocities"], like[1]),
            None,
            None,
            None,
            *(
                native.tensor(given[n], like[k])
                for k, n in ((5, "by_pulls"), (6, "by_bends"), (7, "by_eases"), (8, "by_pushes"))
            ),
        )


_flow: Callable[..., Tensor] = _Flow.apply


def _launch(kernel: Any, sizes: list[int], addresses: list[int]) -> None:
    numbers, table = np.array(sizes, dtype=np.int32), np.array(addresses, dtype=np.int64)
    inputs = [numbers.ctypes.data, table.ctypes.data]
    warp_module().launch(kernel, dim=1, inputs=inputs, device="cpu", record_tape=False)


@cache
def _kernels() -> ModuleType:
    """The kernels' module, imported late: it imports Warp."""
    from physworld.worldmodel.native import chain_kernels

    return chain_kernels
