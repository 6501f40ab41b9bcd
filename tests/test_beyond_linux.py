"""What is not real time imports and works without what only Linux has; real time says that it needs Linux."""

import os
import re
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from tests.beyond_linux import POSIX_MODULES
from tests.cli.cli_cases import CONFIGURATION, STUDY, Commands, assert_equal, expected, simulated
from tests.refusals import refused

import faintspot as fs
from faintspot.base import errors
from faintspot.cli.realtime import command as realtime

SCRIPT = Path(__file__).with_name("beyond_linux.py")
MEASURE = "slopes frames.npy --config faintspot.toml -o slopes.zarr"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "modules", "commands", "last_line"),
    [
        # joblib counts processors with psutil, which reads /proc here and elsewhere does not.
        (
            "macos",
            300,
            ("--version", MEASURE, "realtime run"),
            "faintspot realtime run needs Linux",
        ),
        (
            "windows",
            220,
            (
                "--version",
                MEASURE,
                f"{MEASURE} --overwrite",
                *2 * ("slopes frames.npy --config faintspot.toml -o slopes.npz --overwrite",),
                "wavefront slopes.zarr -o wavefront.json",
                "study study.toml --workers 1",
                "layout frames.npy --grid 4x4 --pixels 8 -o new.toml --overwrite",
                "realtime run",
            ),
            "faintspot realtime needs Linux",
        ),
    ],
    ids=["macos", "windows"],
)
def test_everything_imports_and_what_is_not_real_time_works(
    tmp_path: Path, system: str, modules: int, commands: tuple[str, ...], last_line: str
) -> None:
    """On such systems, as far as Linux can be taken away."""
    for package in ("hcipy", "pyshmem", "specula", "tornado", "xarray"):
        pytest.importorskip(package)
    frames = simulated()
    np.save(tmp_path / "frames.npy", frames)
    (tmp_path / "faintspot.toml").write_text(CONFIGURATION)
    (tmp_path / "study.toml").write_text(STUDY)
    done = subprocess.run(
        [sys.executable, SCRIPT, system, *commands],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        capture_output=True,
        text=True,
        timeout=500,
        stdin=subprocess.DEVNULL,
    )
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1] == f"faintspot: error: {last_line}"
    assert done.returncode == 2
    assert int(done.stdout.split()[0]) > modules
    assert "cannot be found out" not in done.stdout
    assert_equal(tmp_path / "slopes.zarr", expected(frames))
    assert "400/400" in done.stderr or system == "macos"  # realisations of the study
    written = [words[words.index("-o") + 1] for command in commands if "-o" in (words := command.split())]
    assert all((tmp_path / name).exists() for name in written), written


def test_modules_of_posix_are_imported_by_the_engine_only() -> None:
    package = Path(fs.__file__).parent
    imported = re.compile(rf"^(?:import|from) (?:{'|'.join(POSIX_MODULES)})\b", re.MULTILINE)
    users = {
        file.relative_to(package).parts[0]
        for file in package.rglob("*.py")
        if imported.search(file.read_text())
    }
    assert users == {"engine"}


def test_real_time_needs_linux(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(realtime, click.Group)
    context = click.Context(realtime)
    names = [name for name in realtime.list_commands(context) if name != "learn"]
    commands = {name: realtime.get_command(context, name) for name in names}
    assert {"run", "telescope", "record", "send"} <= set(commands)
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    for name, command in commands.items():
        assert command is not None
        assert command.callback is not None
        with click.Context(command, info_name=name), refused(name, "Linux"):
            command.callback()


def test_other_ways_into_real_time(run: Commands, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(errors, "SHARED_MEMORY", tmp_path / "none")
    for line in ("live", "realtime demo"):
        run.refused(*line.split(), naming=("needs shared memory", "which Linux has"))
