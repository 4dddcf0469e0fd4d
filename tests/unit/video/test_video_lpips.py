"""LPIPS by a network of random weights: what holds for any weights, and one layer beside a plain numpy reckoning."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.video.lpips import _LAYERS, LEAST_SIDE_PX, NETS, Lpips, LpipsNet, LpipsWeights

pytestmark = pytest.mark.slow


def random_weights(net: LpipsNet) -> LpipsWeights:
    """Weights under which a layer neither dies nor grows."""
    rng = np.random.default_rng(0)
    layers = _LAYERS[net]
    kernels, biases, linear = [], [], []
    for layer in layers:
        side, coming, going = layer.shape
        spread = np.sqrt(2.0 / (side * side * coming))
        kernels.append(rng.normal(0.0, spread, (side, side, coming, going)).astype(np.float32))
        biases.append(rng.normal(0.0, 0.1, going).astype(np.float32))
        if layer.kept:
            linear.append(rng.uniform(0.0, 1.0, going).astype(np.float32))
    return LpipsWeights(net, tuple(kernels), tuple(biases), tuple(linear))


def pictures(height: int = 48, width: int = 64) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:height, :width]
    one = np.stack([0.5 + 0.4 * np.sin(x / 9), y / height, 0 * x + 0.3], axis=-1)
    return one, np.clip(one + np.random.default_rng(1).normal(0.0, 0.1, one.shape), 0.0, 1.0)


def first_layer(picture: np.ndarray, weights: LpipsWeights) -> np.ndarray:
    """AlexNet's first layer with its rectifier, (h, w, 64): a sum over windows, 11 px wide and 4 px apart."""
    scaled = (2.0 * picture - 1.0 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    padded = np.pad(scaled, ((2, 2), (2, 2), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (11, 11), axis=(0, 1))[::4, ::4]
    return np.maximum(np.einsum("hwcij,ijco->hwo", windows, weights.kernels[0]) + weights.biases[0], 0.0)


def test_one_layer_is_that_of_a_plain_reckoning() -> None:
    weights = random_weights("alexnet")
    layers = [first_layer(picture, weights) for picture in pictures()]
    unit = [layer / np.linalg.norm(layer, axis=2, keepdims=True) for layer in layers]
    wanted = (((unit[0] - unit[1]) ** 2) @ weights.linear[0]).mean()
    assert Lpips(weights).by_layer(*pictures())[0] == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("net", NETS)
def test_it_is_a_distance(net: LpipsNet) -> None:
    distance = Lpips(random_weights(net))
    one, other = pictures()
    assert distance(one, one) == 0.0
    assert distance(one, other) == pytest.approx(distance(other, one), rel=1e-5) and distance(one, other) > 0
    assert distance.by_layer(one, other).shape == (5,) and (distance.by_layer(one, other) > 0).all()
    nearer = 0.9 * one + 0.1 * other
    assert distance(one, nearer) < distance(one, other)
    least = LEAST_SIDE_PX[net]
    assert distance(one[:least, :least], other[:least, :least]) > 0


def test_what_cannot_be_compared_is_refused_with_its_sizes() -> None:
    weights = random_weights("alexnet")
    distance = Lpips(weights)
    one, _ = pictures()
    with pytest.raises(ValueError, match=r"pictures of 64 x 30 px; LPIPS by alexnet needs 31 px"):
        distance(one[:30], one[:30])
    with pytest.raises(ValueError, match=r"got \(48, 64, 3\) and \(47, 64, 3\)"):
        distance(one, one[1:])
    with pytest.raises(ValueError, match=r"the linear of alexnet have shapes"):
        LpipsWeights("alexnet", weights.kernels, weights.biases, weights.linear[1:])
    with pytest.raises(ValueError, match=r"the kernels of alexnet have shapes .*, not \[\(11, 11, 3, 64\)"):
        LpipsWeights("alexnet", weights.kernels[::-1], weights.biases, weights.linear)
