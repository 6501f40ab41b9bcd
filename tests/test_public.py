import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import loaded

import faintspot

HEAVY = ("numba", "llvmlite", "scipy", "astropy", "zarr", "matplotlib", "jinja2", "tomlkit", "rich", "click")


def test_names_exist_and_are_documented() -> None:
    assert set(faintspot.__all__) <= set(dir(faintspot))
    for name in set(faintspot.__all__) - {"__version__"}:
        item = getattr(faintspot, name)
        assert inspect.getdoc(item), name
        assert inspect.ismodule(item) or item.__name__ == name


def test_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nothing_like_this"):
        _ = faintspot.nothing_like_this


def test_flags_are_different_bits() -> None:
    values = [flag.value for flag in faintspot.SubapertureFlag]
    assert len(set(values)) == len(values) == 8
    assert all(value.bit_count() == 1 and value < 256 for value in values)


def imported_by(statement: str) -> set[str]:
    """Return the heavy packages that a fresh interpreter has loaded after a statement."""
    code = f"import sys\n{statement}\nprint(*(name for name in {HEAVY!r} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(result.stdout.split())


@pytest.mark.slow
def test_import_is_light() -> None:
    assert imported_by("import faintspot") == set()


@pytest.mark.slow
def test_sensor_needs_no_kernels() -> None:
    """Neither the sensor nor the declaration of options; settings have an estimator, which has a kernel."""
    statement = (
        "import faintspot, faintspot.base.options, faintspot.base.tables\n"
        "faintspot.Layout.grid((2, 2), pixels=4)\nfaintspot.Calibration()"
    )
    assert imported_by(statement) <= {"scipy"}


@pytest.mark.slow
def test_settings_load_no_more_than_numba_and_scipy() -> None:
    statement = "import faintspot\nfaintspot.Settings(noise_std=1.0)"
    assert imported_by(statement) <= {"numba", "llvmlite", "scipy"}


def test_no_assert_checks_anything() -> None:
    """They vanish under `python -O`; the tests that plug-ins inherit assert."""
    source = Path(faintspot.__file__).parent
    for path in source.rglob("*.py"):
        if path.name != "testing.py" and "assert" in (text := path.read_text()):
            assert not any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(text))), path


@pytest.mark.slow
@pytest.mark.parametrize("name", list(loaded.TASKS))
def test_tasks_load_no_more_code_than_they_need(name: str) -> None:
    task = loaded.TASKS[name]
    assert sum(loaded.loaded(task).values()) <= task.most_lines
