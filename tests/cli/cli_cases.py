"""A small sensor, its frames and ways to run the command line, for the tests of the commands."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot
from faintspot import Layout, Settings, SlopePipeline, Slopes
from faintspot.cli import main
from faintspot.io import read_slopes
from faintspot.slopes.simulate import Detector, sensor_frames

LAYOUT = Layout.grid((4, 4), pixels=8)
SETTINGS = Settings(noise_std=2.0, keep_brightest=10)
CONFIGURATION = """
[layout.grid]
shape = [4, 4]
pixels = 8

[estimator]
name = "tv"
noise_std = 2.0
keep_brightest = 10
"""
STUDY = """
name = "small"
realisations = 200

[sweeps.flux]
flux_e = [30, 100]
"""


@dataclass
class Result:
    """What a command answered."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The only line on standard error."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert "Traceback" not in self.err
        return lines[0]


class Commands:
    """Runs commands in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str | Path | float) -> Result:
        self._capsys.readouterr()
        code: Any = 0
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as error:
            code = error.code
        captured = self._capsys.readouterr()
        return Result(int(code or 0), captured.out, captured.err)

    def ok(self, *arguments: str | Path | float) -> Result:
        """Run a command that must succeed."""
        result = self(*arguments)
        assert result.code == 0, result.err
        return result

    def refused(self, *arguments: str | Path | float, naming: tuple[str, ...] = ()) -> Result:
        """Run a command that must end with one line that names what is wrong, and exit code 2."""
        result = self(*arguments)
        assert result.code == 2, result
        assert result.error.startswith("faintspot: error: ")
        assert result.out == ""
        for text in naming:
            assert text in result.error, result.error
        return result


def simulated(n_frames: int = 30, seed: int = 1) -> NDArray[np.uint16]:
    """Return frames of LAYOUT: 16 spots of 400 e- at 2 e- of read noise, an offset of 20."""
    detector = Detector(read_noise_e=2.0, offset_adu=20.0, bits=16)
    frames, _ = sensor_frames(
        LAYOUT, n_frames, flux_e=400.0, detector=detector, rng=np.random.default_rng(seed)
    )
    return np.asarray(frames, np.uint16)


def expected(frames: NDArray[Any], **options: Any) -> Slopes:
    """Return what SlopePipeline makes of the same frames."""
    return SlopePipeline(LAYOUT, SETTINGS, **options)(frames)


def assert_equal(path: Path, slopes: Slopes) -> None:
    """Every variable of a file equals the slopes, bit for bit."""
    stored = read_slopes(path)
    assert stored.complete
    for name in ("x", "y", "flux", "valid", "flags", "iterations", "bad_pixels"):
        np.testing.assert_array_equal(stored.variables[name], getattr(slopes, name), err_msg=name)


def command_line(*arguments: str | Path | int, **options: Any) -> subprocess.Popen[str]:
    """Start a command in a process of its own."""
    source = str(Path(faintspot.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", "faintspot", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": source},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )
