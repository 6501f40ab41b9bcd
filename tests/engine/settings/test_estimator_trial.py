"""Whatever a file with estimators does in its trial, this process goes on and is told in one line."""

import hashlib
import os
from pathlib import Path

import pytest
from tests.engine.bench import SETTINGS, make
from tests.engine.estimator_files import PEAK, write
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.settings.estimators import EstimatorTrial, load_estimators
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.registry import restore

pytestmark = pytest.mark.slow


def trial(path: Path, limit_s: float = 60.0) -> EstimatorTrial:
    # With a value that differs between sub-apertures, too.
    return EstimatorTrial(path, make, SETTINGS.replace(where=[0, 3], search_range_px=2.0), limit_s)


def test_what_passes(tmp_path: Path) -> None:
    """It runs in another process, which may print what it likes."""
    path = write(tmp_path, f"print('{{')\nos.environ['FS_TRIAL'] = 'x'\n{PEAK}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert trial(path).elsewhere() == {"estimators": ["mine"], "digest": digest}
    assert "FS_TRIAL" not in os.environ
    assert "mine" not in estimators()


@pytest.mark.parametrize(
    ("body", "top", "message"),
    [
        ("os._exit(3)", "", "exit status 3"),
        ("ctypes.string_at(0)", "", "SIGSEGV"),
        (PEAK, "os._exit(0)", "exit status 0"),
    ],
)
def test_what_ends_its_process(tmp_path: Path, body: str, top: str, message: str) -> None:
    with refused("my_estimator.py", match=message):
        trial(write(tmp_path, body, top)).elsewhere()


@pytest.mark.parametrize(
    ("body", "top", "message"),
    [
        ("raise SystemExit(0)", "", "SystemExit: 0"),
        ("raise KeyboardInterrupt", "", "KeyboardInterrupt"),
        ("return images", "", r"expected shape \(16, 2\), got \(16, 8, 8\)"),
        ("if images.max() == 0:\n    raise ValueError('dark')\nreturn sensor.zero", "", "ValueError: dark"),
        (PEAK, "raise SystemExit", "SystemExit"),
    ],
)
def test_what_is_refused(tmp_path: Path, body: str, top: str, message: str) -> None:
    before = estimators()
    try:
        with pytest.raises(fs.InputError, match=message) as caught:
            trial(write(tmp_path, body, top)).here()
    finally:
        restore(before)
    assert "my_estimator.py" in str(caught.value)


def test_one_that_does_not_let_go_of_the_interpreter(tmp_path: Path) -> None:
    """Compiled code that keeps Python's lock: no thread could end it."""
    with pytest.raises(fs.InputError, match="did not return within 3 s"):
        trial(write(tmp_path, top="ctypes.PyDLL(None).sleep(600)"), 3.0).elsewhere()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\n", "found none"),
        ("def (\n", r"line 1"),
        ("a\0b", "null"),
        ("import faintspot\nx = 1 / 0\n", r"\(line 2\): ZeroDivisionError"),
    ],
)
def test_files_that_register_nothing(tmp_path: Path, text: str, message: str) -> None:
    before, path = estimators(), tmp_path / "bad.py"
    path.write_text(text)
    with pytest.raises(fs.InputError, match=message):
        load_estimators(path)
    with pytest.raises(fs.InputError, match="No such file"):
        load_estimators(tmp_path / "none.py")
    assert estimators() == before


def test_names_that_are_taken(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text().replace('"mine"', '"tv"'))
    with pytest.raises(fs.InputError, match="'tv'"):
        load_estimators(path)
    assert estimators()["tv"].__module__ == "faintspot.slopes.estimators.built_in.total_variation"
