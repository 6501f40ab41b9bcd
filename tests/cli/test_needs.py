"""Without extras, commands say at their start what they need, and those that can do their job do it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from tests.cli.cli_cases import Commands
from tests.shared_data import ROOT

from faintspot.base.errors import EXTRAS
from faintspot.cli import group

pytestmark = pytest.mark.slow

OPTIONAL = sorted({package for packages in EXTRAS.values() for package in packages})
NEEDING = {
    "report slopes.npz": "report",
    "study study.toml": "loop",
    "study paper --quick": "loop",
    "study estimators --quick": "loop",
    "loop magnitude --quick": "loop",
    "realtime run": "realtime",
    "realtime bridge stream": "realtime",
    "realtime record night.zarr": "realtime",
    "export telemetry night.zarr -o night.fits": "realtime",
    "slopes frames.npy": "io",
    "slopes frames.npy -o slopes.fits": "io",
    "tune --read-noise-e 3 --pixels 16 --fwhm-px 1.8 --flux-e 100 -o new.toml --picture tune.png": "report",
    "layout frames.npy -o new.toml --picture layout.png": "report",
    "wavefront slopes.npz --picture wavefront.png": "report",
}
# In a process where nothing has imported an optional package before, and nothing can.
_WITHOUT = """
import importlib.abc, json, sys

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

blocked, commands = json.loads(sys.argv[1])
sys.meta_path.insert(0, Blocked())
from faintspot.cli import main
from faintspot.experiments import demonstration
demonstration.BEST_KEPT, demonstration.STRENGTH_FACTORS = (8, 16), (1.0,)  # fewer candidates
for command in commands:
    main(command.split())
"""


@pytest.fixture
def no_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    known = [name for name in sys.modules if name.partition(".")[0] in OPTIONAL]
    for name in [*OPTIONAL, *known]:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.usefixtures("no_extras")
@pytest.mark.parametrize("line", NEEDING)
def test_what_cannot_be_done_is_said_first(line: str, folder: Path, run: Commands) -> None:
    before = sorted(folder.iterdir())
    run.refused(*line.split(), naming=(f"pip install 'faintspot[{NEEDING[line]}]'",))
    assert sorted(folder.iterdir()) == before


@pytest.mark.usefixtures("no_extras")
def test_all_that_is_missing_is_named(folder: Path, run: Commands) -> None:
    run.refused("report", "slopes.npz", naming=("faintspot report needs matplotlib and jinja2:",))
    run.refused("slopes", "frames.npy", "-o", "night.zarr", naming=("needs zarr", "-o night.npz"))


def test_help_names_the_extra(run: Commands) -> None:
    for line, extra in NEEDING.items():
        command: click.Command | None = group
        names = line.split()
        while isinstance(command, click.Group):
            command = command.get_command(click.Context(command), names.pop(0))
        assert command is not None
        if command.epilog:
            assert f"faintspot[{extra}]" in command.epilog
    assert "faintspot[loop]" in run.ok("loop", "magnitude", "--help").out


def test_the_rest_is_done_and_what_is_left_out_is_said(tmp_path: Path) -> None:
    commands = [
        "demo --frames 20",
        "layout faintspot-demo/frames.npy -o found.toml",
        "slopes faintspot-demo/frames.npy --config found.toml -o slopes.npz",
        "wavefront slopes.npz -o wavefront.json",
        "tune --read-noise-e 3 --pixels 8 --fwhm-px 2 --flux-e 1000 -o tuned.toml",
        "loop show",
        "estimators",
    ]
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT, json.dumps([OPTIONAL, commands])],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("without ")]
    assert [line.partition(":")[0] for line in lines] == ["without report page", *["without picture"] * 3]
    assert all("pip install 'faintspot[report]'" in line for line in lines)
    assert done.stderr.index(lines[0]) == 0  # before any work
    assert "slopes.zarr" not in done.stdout  # what is suggested can be done
    made = {path.name for path in (tmp_path / "faintspot-demo").iterdir()}
    assert made == {"frames.npy", "truth.npy", "tv.toml", "tv.npz", "no-tv.toml", "no-tv.npz"}
    for name in ("found.toml", "slopes.npz", "wavefront.json", "tuned.toml"):
        assert (tmp_path / name).exists()


def test_extras_are_those_of_the_package() -> None:
    import tomllib

    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        names = {line.partition(">")[0].partition("[")[0].replace("-", "_") for line in declared[extra]}
        imported = {"pillow": "pil", "pyrtcao": "pyrtc"}  # where a package is not named like what it installs
        expected = {imported.get(name, name) for name in names - {"faintspot"}}
        assert {package.lower() for package in packages} == expected
