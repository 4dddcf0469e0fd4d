"""Kernels of the chain prior: its flow over a tick, that flow's adjoint, and whole rollouts of the prior alone.

Equations: ``physworld.worldmodel.priors.chain``; the same in torch, one operation after the other: ``chain_step``. The
text (``chain_text``) is also part of the rollout engine (``engine_kernels``). CPU only, one thread.
"""

from __future__ import annotations

import warp as wp

from physworld.worldmodel.native.chain_text import ADJOINT, STEP, TEXT, VECTORS

wp.set_module_options({"enable_backward": False})

CHAIN_SIZES = (
    "chain_nodes", "chain_width", "chain_groups", "chain_substeps", "chain_calms", "chain_lags", "chain_curved",
)  # fmt: skip
CHAIN_ARRAYS = (
    "chain_spread", "chain_read", "chain_hold", "chain_member", "chain_offset", "chain_anchor", "chain_first",
    "chain_second", "chain_axis", "chain_markers", "chain_length", "chain_pull", "chain_lightness", "chain_curve",
    "chain_bend", "chain_keep", "chain_calm", "chain_calm_back", "chain_smooth", "chain_slack", "chain_dash",
    "chain_share", "chain_reach", "chain_gravity", "chain_free", "chain_natural", "chain_carry",
    "chain_normal", "chain_twist", "chain_between", "chain_scratch",
)  # fmt: skip


def unpack(names: tuple[str, ...], table: str, kind: str) -> str:
    """C++ that names the entries of ``table``: numbers of ``kind``, or addresses of its arrays (``kind*``)."""
    if kind.endswith("*"):
        return "\n".join(
            f"{kind} {n} = ({kind})((const long long*){table})[{i}];" for i, n in enumerate(names)
        )
    return "\n".join(f"const {kind} {n} = ((const {kind}*){table})[{i}];" for i, n in enumerate(names))


FLOW_ARRAYS = (
    "places", "velocities", "heres", "slopes", "turns", "pulls", "bends", "eases", "pushes", "traces",
    "by_velocities", "by_pulls", "by_bends", "by_eases", "by_pushes",
)  # fmt: skip
ROLL_SIZES = ("candidates", "frames", "objects", "vertices", "controls", "first")
ROLL_ARRAYS = ("paths", "logs")
SCRATCH_ROWS = 76

_FLOW_HEAD = (
    VECTORS
    + unpack((*CHAIN_SIZES, "count", "back"), "sizes", "int")
    + "\n"
    + unpack((*CHAIN_ARRAYS, *FLOW_ARRAYS), "arrays", "float*")
    + TEXT
)

_FLOW = (
    _FLOW_HEAD
    + ADJOINT
    + r"""
    for (int b = 0; b < count; ++b) {
        const long long at3 = (long long)b * 3 * W, at1 = (long long)b * W + 16;
        float* trace = traces ? traces + (long long)b * S * 3 * W : nullptr;
        if (!back)
            flow(places + at3, velocities + at3, heres + at3, slopes + at3, turns + at3, pulls + at1, bends + at1,
                 eases + at1, pushes + at3, trace);
        else
            unflow(trace, places + at3, by_velocities + at3, pulls + at1, bends + at1, eases + at1, pushes + at3,
                   by_pulls + at1, by_bends + at1, by_eases + at1, by_pushes + at3);
    }
"""
)

_ROLL = (
    VECTORS
    + unpack((*CHAIN_SIZES, *ROLL_SIZES), "sizes", "int")
    + "\n"
    + unpack((*CHAIN_ARRAYS, *ROLL_ARRAYS), "arrays", "float*")
    + "\nconst int N = objects, VN = vertices, C = controls;\nfloat* path = paths;\n"
    + TEXT
    + STEP
    + r"""
    for (int b = 0; b < candidates; ++b) {
        path = paths + (long long)b * frames * VN * 3;
        load(logs + (long long)b * N * 2);
        for (int t = first; t < frames - 1; ++t) chain(t, path + (long long)(t + 1) * VN * 3);
    }
"""
)


@wp.func_native(_FLOW)
def _flow(sizes: wp.uint64, arrays: wp.uint64) -> None: ...


@wp.func_native(_ROLL)
def _roll(sizes: wp.uint64, arrays: wp.uint64) -> None: ...


@wp.kernel
def chain_flow(sizes: wp.uint64, arrays: wp.uint64) -> None:
    """Launch with dim 1: the flow of ``count`` chains, or its adjoint where ``back``."""
    _flow(sizes, arrays)


@wp.kernel
def chain_roll(sizes: wp.uint64, arrays: wp.uint64) -> None:
    """Launch with dim 1: fill in the object vertices of ``paths`` from frame ``first`` + 1 on."""
    _roll(sizes, arrays)
