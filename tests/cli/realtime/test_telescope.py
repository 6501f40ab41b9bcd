"""faintspot realtime telescope: its file of Strehl ratios."""

import time
from pathlib import Path

import numpy as np
import pytest

from faintspot.cli.realtime.telescope import _StrehlFile


def test_times_are_those_of_the_middle_of_an_exposure(tmp_path: Path) -> None:
    with _StrehlFile(str(tmp_path / "strehl.csv"), 10.0) as file:
        expected = time.time() + 5.0
        file.write((7.0, 0.5, 200.0, 0.1, 3.0, time.monotonic(), 6.0, 50.0))
    written = np.loadtxt(tmp_path / "strehl.csv", delimiter=",", skiprows=1)
    assert written == pytest.approx([expected, 0.5, 10.0], abs=1.0)
    assert written[1:].tolist() == [0.5, 10.0]
