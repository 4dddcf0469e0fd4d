"""An interpreter without the fixes is named at the start, with the release that has them."""

from __future__ import annotations

import pytest

from physworld_services.interpreter import warning


@pytest.mark.parametrize(
    ("version", "fixed"), [((3, 11, 2), "3.11.10"), ((3, 11, 9), "3.11.10"), ((3, 12, 5), "3.12.6")]
)
def test_an_old_patch_release_is_named_with_the_one_that_is_fixed(
    version: tuple[int, int, int], fixed: str
) -> None:
    said = warning(version)
    assert said is not None and fixed in said and "CVE-2024-6232" in said


@pytest.mark.parametrize("version", [(3, 11, 10), (3, 12, 6), (3, 13, 0), (3, 14, 1)])
def test_a_fixed_interpreter_is_not_spoken_of(version: tuple[int, int, int]) -> None:
    assert warning(version) is None
