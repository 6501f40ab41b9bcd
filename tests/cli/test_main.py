"""The command line as a whole: help, version, what is unknown, and how quickly it answers."""

import subprocess
import sys
from pathlib import Path

import click
import numba
import pytest
from tests.cli.cli_cases import Commands, command_line

import faintspot
from faintspot.cli import group

pytestmark = pytest.mark.slow

COMMANDS = ("demo", "layout", "report", "slopes")


@pytest.mark.parametrize("command", ["", *COMMANDS])
@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_help_fits_screen(run: Commands, command: str, columns: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    text = run.ok(*([command] if command else []), "--help").out
    assert max(map(len, text.splitlines())) <= 100
    assert all(character.isprintable() or character == "\n" for character in text)
    assert text.count(f"  faintspot {command}".rstrip() + " ") >= 1
    assert command == "" or "Example" in text
    assert text == run.ok(*([command] if command else []), "-h").out


def test_every_option_says_what_it_is_for(run: Commands) -> None:
    for command in COMMANDS:
        found = group.get_command(click.Context(group), command)
        assert found is not None
        for parameter in found.params:
            assert parameter.param_type_name == "argument" or parameter.help, parameter.name


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [(MemoryError(), 2, "error: not enough memory"), (KeyboardInterrupt(), 130, "interrupted")],
)
def test_what_ends_a_command(
    folder: Path, run: Commands, error: BaseException, code: int, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import faintspot.cli.slopes as module

    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(module, "measure_recorded", fail)
    (folder / "a.npy").touch()
    result = run("slopes", "a.npy")
    assert result.code == code
    assert result.error.startswith(f"faintspot: {text}")


def test_help_is_in_sections_with_defaults(run: Commands) -> None:
    text = run.ok("tune", "--help").out
    places = [
        text.index(f"\n{heading}:") for heading in ("Sources", "Camera", "Spots", "Guide star", "Options")
    ]
    assert places == sorted(places)
    assert "[default: 0.9]" in text
    assert "INTEGER" not in text + run.ok("realtime", "run", "--help").out


def test_module_runs_as_a_command() -> None:
    process = command_line("--version")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    package, packages, kernels = out.splitlines()
    assert package.startswith(f"faintspot, version {faintspot.__version__}, in ")
    assert f"numba {numba.__version__}" in packages
    assert "lanes of float32" in kernels


def test_help_imports_nothing_heavy() -> None:
    """Help answers at once because nothing slow is imported, which is tested rather than its time."""
    code = (
        "import sys; from faintspot.cli import main; main(['--help']);"
        "print(sorted({'numba', 'scipy', 'astropy', 'zarr', 'matplotlib', 'jinja2'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.splitlines()[-1] == "[]"
