"""Rolling shutter: rows see turbulence and mirror of their own time."""

import numpy as np
import pytest
from tests.loop.simulation.loop_cases import faint, plain, quiet

from faintspot.base.errors import InputError
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.simulation import simulate_loop
from faintspot.loop.simulation.telescope.model import TelescopeModel

pytest.importorskip("hcipy")

PART = 0.8


def test_rows_see_their_own_time() -> None:
    """First, middle and last row are exact; between, interpolation costs less than a tenth of the change."""
    configuration = quiet().replace("camera", rolling_shutter=PART)
    model = TelescopeModel(configuration, 1)
    rng = np.random.default_rng(1)
    commands = rng.normal(0.0, 30.0, (3, model.optics.mirror.commands))
    time, period = 0.1, 1.0 / configuration.control.frame_rate_hz
    seen = model.wavefronts(time, commands[1])[1]
    rows = model.by_rows(time, seen, list(commands))
    count = len(seen)
    largest = 0.0
    for row in (0, count // 4, count // 2, count - 1):
        place = (row + 0.5) / count - 0.5
        other = commands[0 if place < 0 else 2]
        mixed = commands[1] + abs(place) * PART * (other - commands[1])
        expected = model.wavefronts(time + place * PART * period, mixed)[1][row]
        largest = max(largest, np.abs(rows[row] - expected).max())
    assert largest < 0.1 * np.abs(rows - seen).max()
    assert np.abs(rows[count // 2] - seen[count // 2]).max() < 0.05 * np.abs(rows - seen).max()


def test_commands_of_the_frames_around() -> None:
    line = CommandDelayLine(1, 2)
    for number in range(1, 6):
        line.put(np.array([float(number)]))
    before, acting, after = (float(each[0]) for each in line.around)
    assert (before, acting, after) == (3.0, 4.0, 5.0)
    assert acting == float(line.acting[0])


@pytest.mark.slow
def test_a_loop_closes_with_it() -> None:
    """The skew costs little: rows are late or early by up to half a frame."""
    without, rolled = (
        simulate_loop(faint().replace("camera", rolling_shutter=part), [plain()]) for part in (0.0, 1.0)
    )
    assert not np.array_equal(without.slopes_px[5], rolled.slopes_px[5])
    assert abs(rolled.mean_strehl() - without.mean_strehl()) < 0.05


def test_a_delay_without_later_commands_is_refused() -> None:
    rolling = faint().replace("camera", rolling_shutter=0.5)
    with pytest.raises(InputError, match="delay_frames"):
        rolling.replace("control", delay_frames=1)
