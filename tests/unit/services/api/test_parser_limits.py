"""The limits of a process that reads an upload are kept by the kernel."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from physworld_scenes.limited import MEBIBYTE, Limits
from physworld_services.api.parser_process import CPU_S, MEMORY_BYTES, OUTPUT_BYTES, limits_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[4]


def _under(limits: Limits, work: str) -> int:
    """Exit status of a process that imposes the limits on itself and works."""
    numbers = tuple(vars(limits).values())
    program = f"from physworld_scenes.limited import Limits\nLimits(*{numbers}).impose()\n{work}"
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, timeout=60
    ).returncode


def test_processor_time_has_an_end() -> None:
    status = _under(Limits(1, 30, MEMORY_BYTES, OUTPUT_BYTES), "while True: pass")
    assert status in (-signal.SIGXCPU, -signal.SIGKILL)


def test_waiting_has_an_end() -> None:
    assert _under(Limits(30, 1, MEMORY_BYTES, OUTPUT_BYTES), "import time; time.sleep(30)") == -signal.SIGALRM


def test_memory_has_an_end() -> None:
    claim = "try: bytearray({})\nexcept MemoryError: raise SystemExit(7)"
    assert _under(Limits(30, 30, 64 * MEBIBYTE, OUTPUT_BYTES), claim.format(128 * MEBIBYTE)) == 7
    assert _under(Limits(30, 30, 256 * MEBIBYTE, OUTPUT_BYTES), claim.format(128 * MEBIBYTE)) == 0


def test_output_has_an_end(tmp_path: Path) -> None:
    content = f"open({str(tmp_path / 'out')!r}, 'wb').write(bytes({2 * MEBIBYTE}))"
    write = f"try: {content}\nexcept OSError: raise SystemExit(7)"
    assert _under(Limits(30, 30, MEMORY_BYTES, MEBIBYTE), write) == 7
    assert (tmp_path / "out").stat().st_size <= MEBIBYTE


@pytest.mark.parametrize(("size", "cpu_s"), [(0, CPU_S), (512 * MEBIBYTE, CPU_S + 32)])
def test_a_long_recording_may_take_longer_than_a_small_file(size: int, cpu_s: int) -> None:
    limits = limits_of(size)
    assert limits.cpu_s == cpu_s
    assert limits.memory_bytes == MEMORY_BYTES + 8 * size
