from typing import Any

import numpy as np
import pytest
from tests.adapters.adapter_cases import ESTIMATORS, POSITIONS, SIDE, N, images, needs, noisy
from tests.refusals import refused

pytestmark = pytest.mark.filterwarnings("ignore")
GRID = 3
TABLES = {"calibration": {"read_noise_e": 1.0}, "psf": {"profile": "gaussian", "size": 1.0}}


def frame_of(stack: np.ndarray) -> np.ndarray:
    """Return one frame with the images of GRID x GRID sub-apertures."""
    return stack.reshape(GRID, GRID, SIDE, SIDE).transpose(0, 2, 1, 3).reshape(GRID * SIDE, GRID * SIDE)


def idxs() -> np.ndarray:
    numbers = np.arange((GRID * SIDE) ** 2).reshape(GRID * SIDE, GRID * SIDE)
    return numbers.reshape(GRID, SIDE, GRID, SIDE).transpose(0, 2, 1, 3).reshape(N, SIDE * SIDE)


@needs("specula", "specula")
class TestRealTool:
    @pytest.fixture(scope="class")
    def specula(self) -> Any:
        import specula

        specula.init(-1, precision=1)
        return specula

    @pytest.fixture
    def subapertures(self, specula: Any) -> Any:
        from specula.data_objects.subap_data import SubapData

        return SubapData(idxs(), np.arange(N), GRID, GRID)

    def made(self, subapertures: Any, name: str = "centroid", **options: Any) -> Any:
        """Return the class as SPECULA finds it."""
        from specula.lib.utils import import_class

        settings = ESTIMATORS[name]
        tables = {**TABLES, **settings.to_tables()}
        kind = import_class("FaintspotSlopec", ["faintspot.adapters.specula"])
        return kind(subapertures, faintspot=tables, **options)

    def slopes(self, computer: Any, frame: np.ndarray, predicted: Any = None, time: int = 1) -> np.ndarray:
        from specula.data_objects.pixels import Pixels

        pixels = Pixels(frame.shape[1], frame.shape[0])
        pixels.set_value(frame)
        pixels.generation_time = time
        computer.inputs["in_pixels"].set(pixels)
        if predicted is not None:
            computer.inputs["in_predicted"].set(predicted)
        computer.setup()
        computer.check_ready(time)
        computer.trigger()
        computer.post_trigger()
        return np.array(computer.slopes.slopes)

    def test_slopes_are_speculas_own(self, specula: Any, subapertures: Any) -> None:
        from specula.data_objects.slopes import Slopes
        from specula.processing_objects.sh_slopec import ShSlopec

        null = Slopes(slopes=np.linspace(-0.1, 0.1, 2 * N))
        frame = frame_of(np.maximum(images(), 0.0))
        for interleave in (False, True):
            theirs = ShSlopec(subapertures, sn=null, interleave=interleave)
            ours = self.made(subapertures, sn=null, interleave=interleave)
            # The same pixels are summed in float32.
            expected = self.slopes(theirs, frame)
            np.testing.assert_allclose(self.slopes(ours, frame), expected, atol=1e-6)
            np.testing.assert_allclose(ours.slopes_map.value, theirs.slopes_map.value, atol=1e-6)
            assert ours.total_counts.value[0] == pytest.approx(theirs.total_counts.value[0], rel=1e-5)
            assert set(ours.outputs) == {*theirs.outputs, "out_recorded"}
            np.testing.assert_array_equal(ours.recorded.slopes, ours.slopes.slopes)
            assert np.ptp(expected) > 0.2

    def test_slopes_have_the_tools_unit_and_order(self, subapertures: Any) -> None:
        computer = self.made(subapertures, "window", calibrating=True)
        slopes = self.slopes(computer, frame_of(images(5e5))) * (SIDE / 2)
        assert 0.7 < np.polyfit(POSITIONS.T.ravel(), slopes, 1)[0] < 1.2
        assert computer.measured.last.valid.all()

    @pytest.mark.parametrize("interleave", [False, True])
    def test_a_recording_has_no_slopes_without_flux(self, subapertures: Any, interleave: bool) -> None:
        from specula.data_objects.slopes import Slopes

        stack = images()
        stack[2] = 0.0
        null = Slopes(slopes=np.full(2 * N, 0.05))
        computer = self.made(subapertures, interleave=interleave, sn=null)
        slopes = self.slopes(computer, frame_of(stack))
        recorded = computer.recorded
        assert np.isnan([recorded.xslopes[2], recorded.yslopes[2]]).all()
        kept = np.isfinite(recorded.slopes)
        assert np.count_nonzero(~kept) == 2
        np.testing.assert_array_equal(recorded.slopes[kept], slopes[kept])
        np.testing.assert_allclose(slopes[~kept], 0.0, atol=1e-7)  # that of the null

    def test_commands_come_after_their_delay(self, specula: Any) -> None:
        from specula.data_objects.slopes import Slopes
        from specula.lib.utils import import_class

        kind = import_class("FaintspotControl", ["faintspot.adapters.specula"])
        control, sent = kind(lambda slopes: slopes[:2] + slopes[2:], nmodes=2, delay=1), []
        for time in (1, 2, 3):
            slopes = Slopes(slopes=np.array([1.0, 2.0, 3.0, 4.0]) * time)
            slopes.generation_time = time
            control.inputs["in_slopes"].set(slopes)
            control.setup()
            control.check_ready(time)
            control.trigger()
            control.post_trigger()
            sent.append(np.array(control.out_comm.value))
        np.testing.assert_allclose(sent, [[0.0, 0.0], [4.0, 6.0], [8.0, 12.0]])

    def test_predicted_slopes_come_by_an_input(self, subapertures: Any, specula: Any) -> None:
        from specula.data_objects.slopes import Slopes

        true = POSITIONS.T.ravel() / (SIDE / 2)
        null = Slopes(slopes=np.full(2 * N, 0.05))
        predicted = Slopes(slopes=true - 0.05)
        frame = frame_of(noisy(np.random.default_rng(1), 5.0))
        errors = []
        for time in (0, 1):  # generated never, and now
            predicted.generation_time = time
            tables = {
                **TABLES,
                "estimator": {"name": "map", "prior_std_px": 0.1},
                "settings": {"flux_e": 5.0},
            }
            computer = self.made(subapertures, sn=null)
            computer = type(computer)(subapertures, faintspot=tables, sn=null)
            slopes = self.slopes(computer, frame, predicted)
            errors.append(np.std(slopes - (true - 0.05)))
        assert errors[1] < 0.3 * errors[0]  # 5 electrons say little, and a prior of 0.1 px a lot

    def test_refused_in_one_line(self, subapertures: Any, specula: Any) -> None:
        from specula.data_objects.subap_data import SubapData

        with refused("subapdata.idxs", "20 x 20", "899"):
            self.slopes(self.made(subapertures), np.ones((20, 20)))
        with refused("subapdata.idxs", "30 x 40", "others"):
            self.slopes(self.made(subapertures), np.ones((30, 40)))
        backwards = SubapData(idxs()[:, ::-1], np.arange(N), GRID, GRID)
        with refused("subapdata.idxs", "others"):
            self.slopes(self.made(backwards), frame_of(images()))
        with refused("faintspot: "):
            type(self.made(subapertures))(subapertures)
        with refused("slopes: no"):
            _ = self.made(subapertures).measured

    def test_another_system_than_was_calibrated(self, subapertures: Any, specula: Any) -> None:
        from specula.data_objects.slopes import Slopes

        frame = frame_of(images())
        computer = self.made(subapertures)
        self.slopes(computer, frame)
        with refused("in_pixels", "(30, 30)", "(30, 40)"):
            self.slopes(computer, np.ones((30, 40)), time=2)
        with refused("sn: expected slopes of 9 sub-apertures, got 4 x and 4 y; calibr"):
            self.slopes(self.made(subapertures, sn=Slopes(slopes=np.zeros(8))), frame)
        broken = Slopes(slopes=np.full(2 * N, np.nan))
        with refused("sn: ", "18 NaN"):
            self.slopes(self.made(subapertures, sn=broken), frame)
        with refused("filtmat: expected finite numbers", "got 36 NaN or infinite of 36"):
            self.made(subapertures, filtmat=np.full((2, 2, 2 * N), np.nan))
