"""A few seconds of fuzzing; `make fuzz` runs as long as one likes."""

import signal
import subprocess
import sys

import pytest
from tests.fuzz.__main__ import PARTS
from tests.shared_data import ROOT

from faintspot.slopes.kernels.host import lanes_for

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="pages are protected as Linux does it"),
    pytest.mark.slow,
]


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("at_end", "place"), [(True, 10), (False, -1)])
def test_one_element_too_far_ends_the_process(at_end: bool, place: int) -> None:
    code = (
        "import ctypes, numpy; from tests.fuzz.guarded import guarded; "
        f"array = guarded(numpy.arange(10, dtype=numpy.float32), {at_end}); assert array.sum() == 45; "
        f"ctypes.c_float.from_address(array.ctypes.data + 4 * {place}).value"
    )
    assert python("-c", code).returncode == -signal.SIGSEGV


@pytest.mark.parametrize("part", [part for part in PARTS if part != "properties"])
def test_nothing_is_found(part: str) -> None:
    widest = str(lanes_for("float32").width)
    done = python("-m", "tests.fuzz", "--part", part, "--seed", "0", "--minutes", "0.05", "--widths", widest)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
