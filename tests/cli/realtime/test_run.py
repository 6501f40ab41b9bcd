"""faintspot realtime run: what the engine is given."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.engine.commands import needs_shared_memory

pytest.importorskip("pyshmem")

from tests.cli.cli_cases import Commands
from tests.loop.control.control_cases import INTERACTION

from faintspot import Layout, Settings
from faintspot.base.errors import InputError
from faintspot.engine import engine
from faintspot.engine.settings.plan import EngineOptions
from faintspot.loop.control.configuration import save_control

pytestmark = needs_shared_memory


def test_options_are_passed_on(run: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout, settings = Layout.grid((3, 3), pixels=8), Settings("brightest")
    taken: list[tuple[EngineOptions, dict[str, Any]]] = []

    def no_engine(_: str, maker: Any, changing: Settings, options: EngineOptions, **parts: Any) -> None:
        assert (maker.layout, changing) == (layout, settings)
        taken.append((options, parts))
        raise InputError("no engine")

    monkeypatch.setattr(engine, "Engine", no_engine)
    monkeypatch.chdir(tmp_path)
    for part in (layout, settings):
        part.save("faintspot.toml")
    np.save("matrix.npy", INTERACTION)
    save_control("faintspot.toml", interaction_matrix="matrix.npy", gain=0.2)
    machine = ("--deadline-us", 2500, "--threads", 2, "--cpus", "0,1", "--images-every", 7, "--poll")
    methods = ("--interleave", "none,tv:0.6", "--every", 20)
    run.refused("realtime", "run", *machine, "--flux-frames", 30, *methods, naming=("no engine",))
    run.refused("realtime", "run", "--no-control", naming=("no engine",))
    (options, parts), (usual, without) = taken
    assert options == EngineOptions(2, [0, 1], 2500.0 * 1e-6, 7, 30.0, True)
    assert parts["control"].options.gain == 0.2
    assert (parts["interleaving"].labels, parts["interleaving"].every) == (["none", "tv:0.6"], 20)
    assert usual == EngineOptions(deadline_s=1000.0 * 1e-6)
    assert without == {"source": None, "interleaving": None, "control": None}
