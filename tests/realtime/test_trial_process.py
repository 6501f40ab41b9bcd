"""Whatever a module does in its trial, this process goes on and is told in one line."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from tests.realtime.module_cases import LAYOUT, SETTINGS, pipeline, write

import faintspot as fs
from faintspot.realtime.trial_process import Trial


def trial(source: Path, limit_s: float = 60.0) -> Trial:
    # Also of the kind that differs between sub-apertures.
    settings = [SETTINGS, SETTINGS.replace(where=[0, 3], noise_std=2.0)]
    return Trial(str(source), pipeline, settings, limit_s)


def test_what_passes(tmp_path: Path) -> None:
    """It runs in another process, which may print what it likes."""
    path = write(tmp_path, "denoise", "import os\nprint('{')\nos.environ['FS_TRIAL'] = 'x'\nreturn images")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    about = {"name": "module", "stage": "denoise", "source": str(path), "digest": digest}
    assert trial(path).elsewhere() == about
    assert "FS_TRIAL" not in os.environ


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("raise SystemExit(0)", r"module module \(denoise\): SystemExit: 0"),
        ("raise KeyboardInterrupt", r"module module \(denoise\): KeyboardInterrupt"),
        ("raise GeneratorExit", r"module module \(denoise\): GeneratorExit"),
        ("import os\nos._exit(3)", r"module .*module\.py: ended the process of its trial \(exit status 3\)"),
        ("import ctypes\nctypes.string_at(0)", r"module .*module\.py: crashed in its trial \(SIGSEGV\)"),
        ("import os\nos.abort()", r"crashed in its trial \(SIGABRT\)"),
        ("return images[1:]", r"module module \(denoise\): expected shape"),
    ],
)
def test_what_is_refused(tmp_path: Path, body: str, message: str) -> None:
    with pytest.raises(fs.InputError, match=message) as caught:
        trial(write(tmp_path, "denoise", body)).elsewhere()
    assert "\n" not in str(caught.value)


def test_one_that_does_not_let_go_of_the_interpreter(tmp_path: Path) -> None:
    """Compiled code that keeps Python's lock: no thread could end it."""
    path = tmp_path / "endless.py"
    path.write_text("import ctypes\nctypes.PyDLL(None).sleep(600)\n")
    with pytest.raises(fs.InputError, match=r"endless\.py: did not return within 3 s in its trial"):
        trial(path, 3.0).elsewhere()


def test_pipelines_that_cannot_be_sent_are_tried_here(tmp_path: Path) -> None:
    path = write(tmp_path, "denoise", "return images")
    here = Trial(str(path), lambda settings: fs.SlopePipeline(LAYOUT, settings), [SETTINGS])
    assert here.elsewhere() == here.here()
    bad = write(tmp_path, "denoise", "raise SystemExit")
    with pytest.raises(fs.InputError, match="SystemExit"):
        Trial(str(bad), lambda settings: fs.SlopePipeline(LAYOUT, settings), [SETTINGS]).elsewhere()
    assert np.isfinite(pipeline()(np.ones(LAYOUT.frame_shape)).x).all()
