"""Sources of frames end in order when they are interrupted, and leave nothing behind."""

import signal
from pathlib import Path

import numpy as np
import pytest
from tests.engine.commands import needs_shared_memory, start
from tests.patience import LIMIT_S, wait_for

from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.processes.segment import FOLDER

pyshmem = pytest.importorskip("pyshmem")
pytestmark = [needs_shared_memory, pytest.mark.slow]


@pytest.mark.parametrize(
    ("command", "number"), [("sources.bridge", signal.SIGINT), ("sources.replay", signal.SIGTERM)]
)
def test_ends_in_order(name: str, tmp_path: Path, command: str, number: signal.Signals) -> None:
    module, function = command.split(".")
    np.save(tmp_path / "frames.npy", np.ones((30, 6, 5), np.uint16))
    options = {
        "bridge": [f"{name}_in"],
        "replay": [str(tmp_path / "frames.npy"), "--frame-rate-hz", "200", "--repeat"],
    }[function]
    stream = pyshmem.create(f"{name}_in", shape=(6, 5), dtype=np.uint16)
    code = f"from faintspot.cli.realtime.{module} import {function}; {function}()"
    process = start(code, *options, "--name", name)
    wait_for(lambda: (FOLDER / name).exists() or process.poll() is not None)
    ring = PixelRing.attach(name)
    enough = 40 if function == "replay" else 0  # more than there are in the file
    wait_for(lambda: stream.write(np.ones((6, 5), np.uint16)) or ring.progress()[0] >= enough)
    process.send_signal(number)
    out, errors = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, errors) == (0, "")
    assert "frames, " in out.splitlines()[-1]
    assert ring.closed
    assert ring.progress()[1] == ring.shape[0]
    assert not (FOLDER / name).exists()
    stream.unlink()
