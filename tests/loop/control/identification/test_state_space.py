"""Exported matrices, run by the lines of the manual, send the commands of the filter."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import sparse
from scipy.io import loadmat
from tests.loop.control.control_cases import (
    FRAME_S,
    INTERACTION,
    LAYERS,
    PHASE_OF_COMMANDS,
    PLANT,
    TURBULENCE,
    telemetry,
)
from tests.refusals import refused
from tests.shared_data import ROOT

from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification.model import Kalman, state_space, write_matrices
from faintspot.loop.control.kalman.local_predictor import local_filter

MANUAL = ROOT / "docs" / "guide" / "predictive_filter.md"
NOISE_PX2 = np.full(18, 0.25)
SCALE, SIGN, LIMIT = 3.0, -1.0, 0.7
REFERENCE, FLAT = np.linspace(-1, 1, 18), np.linspace(40, 60, 12)
DENSE = {
    "first": LAYERS.first,
    "second": LAYERS.second,
    "driving_px2": LAYERS.driving,
    "variance_px2": NOISE_PX2,
    "covariance_xy_px2": np.zeros(9),
}


@pytest.fixture(scope="module", params=["dense", "sparse"])
def model(request: pytest.FixtureRequest) -> Kalman:
    layers = TURBULENCE.layers()
    arrays: Any = DENSE if request.param == "dense" else local_filter(layers, FRAME_S, NOISE_PX2)
    return Kalman(arrays, 0.3, 1.0, (1.0, 2.0), PHASE_OF_COMMANDS)


def exported(model: Kalman, path: Path) -> dict[str, Any]:
    matrices = state_space(model, PLANT, SCALE, SIGN)
    written = {**matrices, "delay_frames": np.array(2), "largest_command": np.array(LIMIT)}
    written |= {"reference_slopes": REFERENCE, "flat_command": FLAT}
    write_matrices(path, written)
    return matrices


class Loop:
    """A loop closed by exported matrices, whose commands are compared with the filter's."""

    def __init__(self, model: Kalman, frames: int, tolerance: float) -> None:
        self.line, self._tolerance = CommandDelayLine(12, 2, LIMIT), tolerance
        self._filter, self._rows = model.controller(PLANT, self.line), iter(telemetry(frames).open_loop_px)
        self.frames = self.limited = 0

    def get_data(self, check: bool = False) -> np.ndarray:
        """Return slopes, or a command where pyMilk's SHM does not wait for one."""
        if not check:
            return np.zeros((4, 3), np.float32)
        residual = next(self._rows) + INTERACTION @ self.line.acting
        self._filter.update(residual, np.sqrt(NOISE_PX2))
        return np.asarray(residual / SCALE + REFERENCE)[:, None]

    def set_data(self, command: np.ndarray) -> None:
        expected = SIGN * self.line.latest
        np.testing.assert_allclose(command.ravel() - FLAT, expected, rtol=0, atol=self._tolerance)
        self.frames += 1
        self.limited += int(np.abs(self.line.latest).max() == LIMIT)


def test_the_lines_of_the_manual(model: Kalman, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exported(model, Path("matrices.npz"))
    blocks = re.findall(r"```python\n(.*?)```", MANUAL.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = (block for block in blocks if "np.load" in block and ("csr_matrix" in block) == model.is_local)
    run: dict[str, Any] = {}
    exec(block, run)
    loop = Loop(model, 200, (3e-6 if model.is_local else 1e-6) * LIMIT)  # a filter in single precision
    for _ in range(200):
        loop.set_data(run["control"](loop.get_data(check=True)[:, 0]))
    assert 0 < loop.limited < 200


@pytest.mark.parametrize("model", ["dense"], indirect=True)
def test_the_lines_for_milk(model: Kalman, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for pyMilk's SHM; float32: 4e-6 of 60."""
    pytest.importorskip("astropy.io.fits")
    monkeypatch.chdir(tmp_path)
    exported(model, Path("controller.fits"))
    loop = Loop(model, 100, 1e-5)
    interface = SimpleNamespace(SHM=lambda name: loop)
    for name in ("pyMilk", "pyMilk.interfacing", "pyMilk.interfacing.isio_shmlib"):
        monkeypatch.setitem(sys.modules, name, cast(ModuleType, interface))
    page = (ROOT / "docs" / "adapters" / "streams.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with pytest.raises(StopIteration):
        exec(block, {})
    assert loop.frames == 100


def test_every_format_holds_the_same_matrices(model: Kalman, tmp_path: Path) -> None:
    fits = pytest.importorskip("astropy.io.fits")
    paths = {ending: tmp_path / f"matrices.{ending}" for ending in ("npz", "mat", "fits")}
    for path in paths.values():
        matrices = exported(model, path)
    with fits.open(paths["fits"]) as units:
        of_fits = {unit.name.lower(): np.array(unit.data) for unit in units[1:]}
    for file in (dict(np.load(paths["npz"])), loadmat(paths["mat"]), of_fits):
        assert np.ravel(file["delay_frames"]) == [2]
        for name, matrix in matrices.items():
            stored = file[name] if name in file else sparse_of(file, name)
            assert sparse.issparse(stored) == sparse.issparse(matrix)
            np.testing.assert_allclose(plain(stored), plain(matrix), rtol=1e-6)
    with refused(".npz, .mat, .fits"):
        write_matrices(tmp_path / "matrices.csv", {})


def sparse_of(file: dict[str, Any], name: str) -> Any:
    parts = tuple(file[f"{name}_{part}"] for part in ("data", "indices", "indptr"))
    return sparse.csr_matrix(parts, shape=tuple(file[f"{name}_shape"]))


def plain(matrix: Any) -> np.ndarray:
    return np.asarray(matrix.toarray() if sparse.issparse(matrix) else matrix)
