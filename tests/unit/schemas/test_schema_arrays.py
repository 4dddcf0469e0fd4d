"""Arrays on the wire: base64 in pieces, and numbers that cannot be meant."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from physworld_schemas.arrays import PIECE_BYTES, EncodedArray, array_of


@pytest.mark.parametrize("count", [0, 1, 2, 3, PIECE_BYTES // 4, PIECE_BYTES // 4 + 1, PIECE_BYTES // 2 + 7])
def test_what_was_encoded_in_pieces_is_one_text_and_comes_back(count: int) -> None:
    values = np.random.default_rng(0).normal(size=count).astype(np.float32)
    encoded = EncodedArray.of(values)
    assert encoded.data == base64.b64encode(values.tobytes()).decode()
    assert np.array_equal(encoded.numpy(), values)


def test_text_that_is_not_base64_of_the_shape_is_refused() -> None:
    for data in ("?" * 8, "AAAA" * (PIECE_BYTES // 3 + 1) + "AA", "AA=="):
        with pytest.raises(ValueError, match=r"base64|needs"):
            EncodedArray(shape=[2], data=data).numpy()


def test_a_number_beyond_single_precision_is_named() -> None:
    with pytest.raises(ValueError, match=r"1e\+300 at \[1, 0\] is beyond single precision, 3\.403e\+38"):
        EncodedArray.of(np.array([[0.0], [1e300]]))
    assert np.isinf(EncodedArray.of(np.array([np.inf])).numpy()[0]), "what was infinite is refused elsewhere"


def test_a_number_that_is_too_far_is_named_with_its_place_and_the_limit() -> None:
    with pytest.raises(ValueError, match=r"path reaches 1e\+300 at \[0, 1\]; 1000 is the farthest from 0"):
        array_of([[0.0, -1e300]], "path", (2,), 1000.0)
    assert array_of([[1000.0]], "path", (2,), 1000.0).tolist() == [[1000.0]]


@pytest.mark.parametrize("value", [False, True, "1", None])
def test_what_is_no_number_is_refused_in_lists_too(value: object) -> None:
    with pytest.raises(ValueError, match="path is not a regular array of numbers"):
        array_of([[0.0, value]], "path", (2,))
