"""faintspot realtime run: what the engine is given."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyshmem")

from tests.cli.cli_cases import Commands
from tests.loop.control.control_cases import INTERACTION

from faintspot import Layout, Settings
from faintspot.base.errors import InputError
from faintspot.engine import engine
from faintspot.engine.pixels.segment import FOLDER
from faintspot.loop.control.configuration import save_control

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs POSIX shared memory as Linux has it")


def test_options_are_passed_on(run: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[dict[str, Any]] = []

    def no_engine(*_: Any, **options: Any) -> None:
        taken.append(options)
        raise InputError("no engine")

    monkeypatch.setattr(engine, "Engine", no_engine)
    monkeypatch.chdir(tmp_path)
    for part in (Layout.grid((3, 3), pixels=8), Settings("brightest")):
        part.save("faintspot.toml")
    np.save("matrix.npy", INTERACTION)
    save_control("faintspot.toml", interaction_matrix="matrix.npy", gain=0.2)
    machine = ("--deadline-us", 2500, "--threads", 2, "--cpus", "0,1", "--images-every", 7, "--poll")
    methods = ("--interleave", "none,tv:0.6", "--every", 20)
    run.refused("realtime", "run", *machine, "--flux-frames", 30, *methods, naming=("no engine",))
    run.refused("realtime", "run", "--no-control", naming=("no engine",))
    with_control, without = taken
    control, interleaving = with_control.pop("control"), with_control.pop("interleaving")
    assert control.options.gain == 0.2
    assert (interleaving.labels, interleaving.every) == (["none", "tv:0.6"], 20)
    assert with_control.pop("deadline_s") == pytest.approx(2.5e-3)
    assert with_control == {
        "threads": 2, "cpus": [0, 1], "images_every": 7, "polls": True, "mean_flux": 30.0, "source": None,
    }  # fmt: skip
    assert without["control"] is without["interleaving"] is None
    assert without["deadline_s"] == pytest.approx(1e-3)
