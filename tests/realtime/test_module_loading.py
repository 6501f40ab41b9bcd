"""Finding modules: in files, which are read anew, and by entry points."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import pytest

import faintspot as fs
from faintspot.realtime.module_loading import installed_modules, load_module

GOOD = "STAGE = 'denoise'\ndef make(layout, settings):\n    return lambda images: images\n"


def test_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(GOOD)
    module = load_module(path)
    assert (module.name, module.stage, module.source) == ("mine", "denoise", str(path))
    assert module.digest == hashlib.sha256(GOOD.encode()).hexdigest()
    assert module.describe()["name"] == "mine"


def test_a_file_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(GOOD)
    before = load_module(path)
    path.write_text(GOOD.replace("'denoise'", "'background'"))
    after = load_module(path)
    assert (before.stage, after.stage) == ("denoise", "background")
    assert before.digest != after.digest


def test_dataclasses_work_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    text = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    path.write_text(text + "@dataclass\nclass Part:\n    value: int = 1\n" + GOOD)
    assert load_module(path).stage == "denoise"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def make(:\n", r"bad\.py, line 1: invalid syntax"),
        ("\nimport no_such_package\n", r"bad\.py, line 2: ModuleNotFoundError: No module named"),
        ("x = 1\nraise SystemExit\n", r"bad\.py, line 2: SystemExit"),
        ("import this\0", "null bytes"),
        ("def make(layout, settings): ...\n", "expected STAGE = one of 'calibrate', 'denoise'"),
        ("STAGE = 'slopes'\n", "STAGE = 'slopes': expected one of"),
        ("STAGE = ['denoise']\n", r"STAGE = \['denoise'\]: expected one of"),
        ("STAGE = 'denoise'\n", r"expected a function make\(layout, settings\), got none"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.py"
    path.write_text(text)
    known = set(sys.modules)
    with pytest.raises(fs.InputError, match=message) as caught:
        load_module(path)
    assert "\n" not in str(caught.value)
    assert not {name for name in set(sys.modules) - known if name.startswith("faintspot_module_")}


def test_not_there(tmp_path: Path) -> None:
    with pytest.raises(fs.InputError, match="No such file"):
        load_module(tmp_path / "none.py")
    with pytest.raises(fs.InputError, match="Is a directory"):
        load_module(str(tmp_path) + "/")
    with pytest.raises(fs.InputError, match=r"expected a file that ends in \.py, or an installed module"):
        load_module("none")


def test_a_file_that_never_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.realtime.module_loading.LOAD_LIMIT_S", 0.2)
    path = tmp_path / "endless.py"
    path.write_text("while True:\n    pass\n")
    with pytest.raises(fs.InputError, match=r"did not return within 0\.2 s"):
        load_module(path)


def test_entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an installed distribution, such as any package can have."""
    information = tmp_path / "fs_test_modules-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: fs-test-modules\nVersion: 1.0\n")
    points = "[faintspot.modules]\ngentle = fs_test_gentle\nbroken = fs_test_not_there\n"
    (information / "entry_points.txt").write_text(points)
    (tmp_path / "fs_test_gentle.py").write_text(GOOD)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert installed_modules()["gentle"] == "fs_test_gentle"
    module = load_module("gentle")
    assert (module.name, module.stage, module.source) == ("gentle", "denoise", "fs_test_gentle")
    assert module.digest == hashlib.sha256(GOOD.encode()).hexdigest()
    with pytest.raises(fs.InputError, match=r"module 'broken' \(fs_test_not_there\): ModuleNotFoundError"):
        load_module("broken")
