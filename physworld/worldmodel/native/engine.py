"""The fast rollout on a CPU, of one sequence or of a batch of candidates: a model's weights, prepared once.

It is the function of ``rollout.unroll`` in single precision, several times faster: nothing is allocated and nothing
returns to Python between steps. A candidate of a batch is rolled out exactly as it would be alone. The kernel releases
the interpreter's lock, so threads share a batch. A model on another device is copied: the engine is the CPU's.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from types import ModuleType
from typing import cast

import numpy as np
import torch

from physworld.arrays import Array
from physworld.worldmodel.model.features import REST_RADII
from physworld.worldmodel.model.inertia import InertialStep
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.chain_native import chain_arrays, chain_scratch, chain_sizes
from physworld.worldmodel.native.messages import warp_module
from physworld.worldmodel.priors.chain_step import ChainStep
from physworld.worldmodel.priors.prior_step import PriorStep

REGISTER = 16
GAP_FLOOR_M = 1e-7  # rounding: the reference places of object vertices are their rest places


class RolloutEngine:
    """A model's weights, transposed and padded; call :meth:`run` and :meth:`run_batch` as often as you like."""

    def __init__(self, model: WorldModel) -> None:
        spec, config, norm = model.spec, model.config, model.norm
        self.history, self.objects, self.vertices = config.history, spec.object_count, spec.vertex_count
        self.hidden = -(-config.hidden // REGISTER) * REGISTER
        chain = model.prior.prior if isinstance(model.prior, ChainStep) else None
        self._fixed = _pack_weights(model, self.hidden) | {
            "offsets": _integers(model.edges.offsets),
            "edge_sender": _integers(model._senders),
            "edge_receiver": _integers(model._receivers),
            "edge_offset": _floats(model._offset),
            "share": _floats(model._share),
            "reference": _floats(model._reference),
        }
        if chain is not None:
            self._fixed |= chain_arrays(chain)
        elif isinstance(model.prior, PriorStep):
            self._fixed |= {
                "mean": _floats(model.prior.mean),
                "basis": _floats(model.prior.basis),
                "shape": _floats(model.prior.shape),
                "prior_weight": _floats(model.prior.weight),
                "prior_response": _floats(model.prior.response),
            }
        frame = spec.frame
        if frame is not None:
            self._fixed |= {
                name: np.ascontiguousarray(values, dtype=np.float32)
                for name, values in (
                    ("frame_shape", frame.shape),
                    ("frame_fall", frame.fall),
                    ("frame_line", frame.line),
                )
            }
        if model.modes is not None:
            self._fixed |= {
                f"mode_{name}": _floats(getattr(model.modes, name))
                for name in ("shapes", "middle", "scale", "change")
            }
            inputs, width = model.modes.weight.shape
            self._fixed["mode_weight"] = _padded(model.modes.weight, inputs, -(-width // REGISTER) * REGISTER)
        modal = model.prior if isinstance(model.prior, PriorStep) else None
        self._placing = None if modal is None else modal.placing.numpy(force=True).astype(np.float64)
        low, high = (0.0, 0.0) if modal is None else modal.span.tolist()
        self._span: tuple[float, float] = low, high
        self._property_scale = norm.properties.numpy(force=True)
        change, velocity, length = (float(x) for x in (norm.change, norm.velocity, norm.length))
        scalars = [1.0 / velocity, change, 1.0 / length, spec.edge_radius_m, REST_RADII * spec.edge_radius_m]
        self._scalars = np.array(scalars, dtype=np.float32)
        self._sizes = {
            "corrected": int(model.corrects_prior()),
            "first": config.history,
            "history": config.history,
            "objects": spec.object_count,
            "vertices": spec.vertex_count,
            "edges": spec.edge_count,
            "layers": config.message_passing_steps,
            "hidden": self.hidden,
            "chained": int(chain is not None),
            "inertial": int(isinstance(model.prior, InertialStep)),
            "nearest": spec.current_neighbours,
            "modes": 0 if modal is None else modal.basis.shape[0],
            "controls": spec.control_count,
            "inputs": model.skip.in_features,
            "places_width": 3 * (config.history + 2),
            "grounded": int(spec.ground_height_m is not None),
            "framed": 0 if frame is None else 1 + int(np.any(frame.line)),
            "shapes": 0 if model.modes is None else model.modes.shapes.shape[0],
            "seen": 0 if model.modes is None else model.modes.weight.shape[0],
        }
        self._sizes |= chain_sizes(chain, config.history) if chain is not None else {}

    def run(self, start: Array, driven: Array, phi: Array) -> Array:
        """All vertices (T, V, 3) float32 from object frames (h+1, n, 3), control vertices (T, C, 3), Φ (n, 2)."""
        path: Array = self.run_batch(start, driven[None], phi)[0]
        return path

    def run_batch(self, start: Array, driven: Array, phi: Array, *, threads: int = 1) -> Array:
        """All vertices of every candidate, (B, T, V, 3) float32.

        Args:
            start: object frames (h+1, n, 3), or (B, h+1, n, 3) where candidates start differently.
            driven: control vertices, (B, T, C, 3).
            phi: log property ratios, (n, 2) or (B, n, 2).
            threads: that share the candidates.
        """
        candidates, frames, n = driven.shape[0], driven.shape[1], self.objects
        path = np.zeros((candidates, frames, self.vertices, 3), dtype=np.float32)
        path[:, : self.history + 1, :n] = start
        path[:, :, n:] = driven
        shared = np.broadcast_to(np.asarray(phi, dtype=np.float64), (candidates, n, 2))
        scaled = np.ascontiguousarray(shared / self._property_scale, dtype=np.float32)
        logs = np.ascontiguousarray(shared, dtype=np.float32)
        soft = self._softness(shared).astype(np.float32)
        bounds = np.linspace(0, candidates, min(threads, candidates) + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(bounds) if b > a]
        launches = [(path[part], scaled[part], soft[part], logs[part]) for part in parts]
        if len(launches) <= 1:
            for launch in launches:
                self._launch(*launch)
            return path
        warp_module().load_module(_kernels(), device="cpu")  # before threads could race to compile it
        with ThreadPoolExecutor(len(launches)) as pool:
            for done in [pool.submit(self._launch, *launch) for launch in launches]:
                done.result()
        return path

    def _softness(self, phi: Array) -> Array:
        """ζ of the modal prior from Φ (B, n, 2), (B,); 0 where there is another one or none."""
        if self._placing is None:
            return np.zeros(len(phi))
        soft: Array = np.clip(np.tensordot(phi, self._placing, axes=2), *self._span)
        return soft

    def _with_room(self, nearest: int) -> dict[str, Array]:
        """Edge arrays of one call with room for the NEAR edges of a step, and the search's working memory."""
        room = self.objects * nearest

        def longer(kept: Array) -> Array:
            return np.concatenate([kept, np.zeros((room, *kept.shape[1:]), dtype=kept.dtype)])

        edges = {name: longer(self._fixed[name]) for name in ("edge_sender", "edge_rest", "edge_gap")}
        return edges | {
            "gapped": self._fixed["gapped"].copy(),
            "found": np.zeros(self.objects, dtype=np.int32),
            "search_room": np.zeros(nearest + 3 * self.objects, dtype=np.float32),
        }

    def _launch(self, path: Array, phi: Array, soft: Array, logs: Array) -> None:
        """Fill in ``path`` (B, T, V, 3) in place; the arrays are contiguous float32."""
        kernels, candidates, frames = _kernels(), path.shape[0], path.shape[1]
        sizes = self._sizes | {"candidates": candidates, "frames": frames}
        rows, edges = self.vertices * self.hidden, sizes["edges"]
        scratch = dict.fromkeys(("state", "hear", "say", "placed", "heard", "sent", "sums", "inner"), rows)
        scratch |= {
            "amplitudes": frames * sizes["modes"],
            "features": self.vertices * sizes["inputs"],
            "places": self.vertices * sizes["places_width"],
            "correction": self.objects * REGISTER,
            "length": edges + self.objects * sizes["nearest"],
            "regressors": self._fixed["prior_weight"].shape[1] if sizes["modes"] else 0,
            "ahead": 3 * self.vertices,
            "window": 3 * self.vertices * (self.history + 2) if sizes["framed"] else 0,
        }
        if sizes["shapes"]:
            parts, moved = (
                -(-3 * count // REGISTER) * REGISTER for count in (self.history + 2, sizes["shapes"])
            )
            scratch |= {"mode_parts": self.objects * parts, "mode_own": sizes["shapes"] * parts}
            scratch |= {"mode_seen": sizes["seen"], "mode_moved": moved}
        arrays = self._fixed | {name: np.zeros(count, dtype=np.float32) for name, count in scratch.items()}
        arrays |= {"paths": path, "phis": phi, "softnesses": soft, "logs": logs}
        if sizes["nearest"]:
            arrays |= self._with_room(sizes["nearest"])
        if sizes["chained"]:
            arrays["chain_scratch"] = chain_scratch(sizes["chain_width"])
        addresses_of = [arrays[name].ctypes.data if name in arrays else 0 for name in kernels.ARRAYS]
        table = np.array(addresses_of, dtype=np.int64)
        numbers = np.array([sizes.get(name, 0) for name in kernels.SIZES], dtype=np.int32)
        addresses = [numbers.ctypes.data, self._scalars.ctypes.data, table.ctypes.data]
        warp_module().launch(kernels.rollout, dim=1, inputs=addresses, device="cpu", record_tape=False)


@cache
def _kernels() -> ModuleType:
    """The kernel's module, imported late: it imports Warp."""
    from physworld.worldmodel.native import engine_kernels

    return engine_kernels


def _pack_weights(model: WorldModel, hidden: int) -> dict[str, Array]:
    """Every weight as (…, in, out), widths padded to ``hidden``; layers stacked.

    What is constant of an edge's first product, (E, H) a layer, is too much to read every step. Its part that is linear
    in reference places is a difference of vertex quantities, as the moving part is, and joins ``position``; what
    remains is |r_rest| times one row, and for edges whose reference is not their rest (grips) three rows more.
    """
    with torch.inference_mode():
        constants = model.edge_constants()
    own, wide = model.config.hidden, hidden

    def stack(layers: torch.nn.ModuleList, blocks: int = 1) -> Array:
        weights = (cast(torch.nn.Linear, layer).weight for layer in layers)
        split = (weight.split(own, dim=1) for weight in weights)  # type: ignore[no-untyped-call]  # torch's has no types
        parts = [_padded(part.T, wide, wide) for block in split for part in block]
        return np.stack(parts).reshape(len(layers), blocks, wide, wide)

    def biases(layers: torch.nn.ModuleList) -> Array:
        return np.stack([_padded(cast(torch.nn.Linear, layer).bias[None], 1, wide)[0] for layer in layers])

    encoder_in, encoder_out = model.encoder.first, model.encoder.out
    decoder_in, decoder_out = model.decoder.first, model.decoder.out
    inputs = encoder_in.in_features
    kinds = [weights.transpose(1, 2) for weights in model.edge_weights()]
    norm, h = model.norm, model.config.history
    near = [part[:3] / norm.length for layer in kinds for part in layer]
    strain = [part[3:6] / norm.strain[kind] for layer in kinds for kind, part in enumerate(layer)]
    rest = [
        (part[6 + 3 * h] / norm.length - part[7 + 3 * h] / norm.stretch[kind])[None]
        for layer in kinds
        for kind, part in enumerate(layer)
    ]
    moving = [part for layer in constants.position for part in layer]
    positions = [
        _padded(torch.cat([own, anchor]), len(own) + 3, wide)
        for own, anchor in zip(moving, near, strict=True)
    ]
    lengths = [_padded(part[None], 1, wide) for layer in constants.length for part in layer]
    gap = model._constants[:, 3:6]
    by_kind = gap.split(model._edges_by_kind)  # type: ignore[no-untyped-call]  # torch's has no types
    gaps = [float(part.abs().max()) if len(part) else 0.0 for part in by_kind]
    return {
        "encode_in": _padded(encoder_in.weight.T, inputs, wide),
        "encode_in_bias": _padded(encoder_in.bias[None], 1, wide),
        "encode_out": _padded(encoder_out.weight.T, wide, wide),
        "encode_out_bias": _padded(encoder_out.bias[None], 1, wide),
        "receive": stack(model.receive),
        "receive_bias": biases(model.receive),
        "send": stack(model.send),
        "position": np.stack(positions),
        "edge_rest": _floats(model._constants[:, 6]),
        "edge_gap": _floats(gap),
        "gapped": np.array([size > GAP_FLOOR_M for size in gaps], dtype=np.int32),
        "length_weight": np.stack(lengths),
        "rest_weight": np.stack([_padded(part, 1, wide) for part in rest]),
        "gap_weight": np.stack([_padded(part, 3, wide) for part in strain]),
        "update_in": stack(model.update_in, 4),
        "update_in_bias": biases(model.update_in),
        "update_out": stack(model.update_out),
        "update_out_bias": biases(model.update_out),
        "decode_in": _padded(decoder_in.weight.T, wide, wide),
        "decode_in_bias": _padded(decoder_in.bias[None], 1, wide),
        "decode_out": _padded(decoder_out.weight.T, wide, REGISTER),
        "decode_out_bias": _padded(decoder_out.bias[None], 1, REGISTER),
        "skip": _padded(model.skip.weight.T, inputs, REGISTER),
    }


def _padded(values: torch.Tensor, rows: int, columns: int) -> Array:
    """As float32 (rows, columns), filled up with zeros."""
    out = np.zeros((rows, columns), dtype=np.float32)
    out[: values.shape[0], : values.shape[1]] = values.numpy(force=True)
    return out


def _floats(values: torch.Tensor) -> Array:
    return np.ascontiguousarray(values.numpy(force=True), dtype=np.float32)


def _integers(values: torch.Tensor) -> Array:
    return np.ascontiguousarray(values.numpy(force=True), dtype=np.int32)
