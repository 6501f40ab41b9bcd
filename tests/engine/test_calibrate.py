"""faintspot realtime calibrate: with a simulated telescope at its own pace, through the streams."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from click.testing import CliRunner, Result
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.base.errors import InputError
from faintspot.cli.realtime.learn import calibrate
from faintspot.engine.control.poking import StreamedMirror
from faintspot.loop.control import mirror_calibration
from faintspot.loop.control.configuration import Control, load_control, save_control

skip_without("hcipy")
pytest.importorskip("matplotlib")
pyshmem = pytest.importorskip("pyshmem")

from tests.engine.closed_loop import COMMANDS, CONFIGURATION, Sky, make_engine  # noqa: E402

pytestmark = pytest.mark.slow

STILL = CONFIGURATION.replace("control", frame_rate_hz=400.0)


@contextmanager
def running(files: tuple[Path, Control], *, control: bool = False) -> Iterator[Sky]:
    """A telescope with high flux and hardly any air, and an engine, both going on by themselves."""
    with Sky(f"fs_test_{uuid4().hex[:12]}", STILL) as sky:
        sky.telescope.order({"r0_m": 100.0, "photons": 1e6})
        sky.start(make_engine(sky.name, files[0], files[1] if control else None))
        with sky.observing():
            yield sky


def copied(path: Path, folder: Path) -> Path:
    """Copy the configuration and its files, which other tests read too."""
    shutil.copytree(path.parent, folder)
    return folder / path.name


def calibrated(path: Path, sky: Sky, *options: str) -> Result:
    arguments = ["--config", str(path), "--name", sky.name, *options]
    return CliRunner().invoke(calibrate, arguments, standalone_mode=False)


def test_the_matrix_is_the_true_one(
    files: tuple[Path, Control], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 1e6 photons the 20 brightest pixels see 0.93 to 1.02 of a displacement, each sub-aperture its own.

    The matrix of the files is in true pixels: columns are in proportion to 3 %, more at the edge.
    """
    path, true = copied(files[0], tmp_path / "found"), files[1]
    monkeypatch.setattr(mirror_calibration, "FEWEST_ROUNDS", 2)
    with running(files) as sky:
        result = calibrated(path, sky, "--error", "0.02", "--amplitude", "100")
        assert result.exception is None, result.exception
        sky.until(lambda: not np.any(sky.telescope.commands.commands_nm))  # it leaves a flat mirror
    assert f"{sky.name}_commands" not in pyshmem.list_streams()
    found = load_control(path)
    assert found is not None
    assert np.abs(found.interaction).max(axis=0).all()  # every actuator has answered
    assert found.options.centroid_gain == 1.0
    assert found.options.gain == true.options.gain
    assert np.corrcoef(found.interaction.ravel(), true.interaction.ravel())[0, 1] > 0.995
    assert 0.9 < (found.interaction * true.interaction).sum() / np.square(true.interaction).sum() < 1.1
    np.testing.assert_allclose(found.reference, true.reference, atol=0.02)
    assert path.with_suffix(".control.png").is_file()
    assert f"{COMMANDS} commands, 72 slopes, 2 rounds of +-100" in result.output
    assert "times those of the former matrix" in result.output


def test_what_is_refused(files: tuple[Path, Control], tmp_path: Path) -> None:
    with running(files, control=True) as sky:
        answer = calibrated(files[0], sky)
        assert "start it with faintspot realtime run --no-control" in str(answer.exception)
    path = tmp_path / "faintspot.toml"
    path.write_text((files[0]).read_text().split("[control]")[0])
    with running(files) as sky:
        assert "--actuators" in str(calibrated(path, sky).exception)
        kept = calibrated(path, sky, "--keep-reference", "--actuators", "5")
        assert "--keep-reference: expected reference_slopes in [control]" in str(kept.exception)
        stream = pyshmem.create(f"{sky.name}_commands", shape=(COMMANDS,), dtype=np.float32)
        somebody = calibrated(path, sky, "--actuators", str(COMMANDS))
        assert "a living process publishes under this name" in str(somebody.exception)
        stream.unlink()
        # A mirror that does not follow: the stream has another length than it expects.
        deaf = calibrated(path, sky, "--actuators", "3", "--rounds", "6")
        assert "the mirror does not answer: pokes of 50" in str(deaf.exception)
        assert "[control]" not in path.read_text()
        large = ("--amplitude", "60", "--actuators", "3")
        limited = copied(files[0], tmp_path / "limited")
        save_control(limited, largest_command=50.0)
        assert "largest_command, 50" in str(calibrated(limited, sky, *large).exception)
        assert not path.with_suffix(".control.npz").exists()
        mirror = StreamedMirror(sky.name, COMMANDS)
        mirror.slopes(np.zeros(COMMANDS))
        sky.stop()
        with refused(sky.name):
            mirror.slopes(np.zeros(COMMANDS))
        mirror.close()
    assert isinstance(calibrated(path, sky, "--actuators", "3").exception, InputError)


def test_numbers_beside_those_found_stay(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    save_control(path, gain=0.2, largest_command=3.0)
    save_control(path, gain=0.3)
    assert "largest_command = 3.0" in path.read_text()
