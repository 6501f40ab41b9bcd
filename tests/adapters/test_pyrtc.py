from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from tests.adapters.adapter_cases import ESTIMATORS, POSITIONS, SIDE, N, images, needs, noisy
from tests.adapters.test_specula import GRID, TABLES, frame_of
from tests.refusals import refused

from faintspot.adapters import pyrtc
from faintspot.adapters.pyrtc import _Measuring

REFERENCE = np.linspace(-0.2, 0.2, 2 * N, dtype=np.float32).reshape(2 * GRID, GRID)


def process(**changes: Any) -> Any:
    """Return what the adapter asks of a slopes process."""
    values: dict[str, Any] = {"num_regions": GRID, "region_size": SIDE, "sub_ap_spacing": float(SIDE)}
    values |= {"offset_x": 0, "offset_y": 0, "ref_slopes": REFERENCE}
    values["valid_sub_aps"] = np.ones((2 * GRID, GRID), bool)
    return SimpleNamespace(**{**values, **changes})


def measuring(name: str = "centroid", **options: Any) -> _Measuring:
    return _Measuring({"faintspot": {**TABLES, **ESTIMATORS[name].to_tables()}, **options})


class Stream:
    def __init__(self, values: np.ndarray, count: int = 1) -> None:
        self.values, self.count = values, count

    def read(self) -> np.ndarray:
        return self.values


def no_stream(name: str) -> Any:
    raise FileNotFoundError(name)


def test_slopes_have_the_tools_unit_and_order() -> None:
    own = measuring("window", noise_free=True)
    maps = own.maps(process(), frame_of(images(5e5)), no_stream)
    assert maps.shape == (2 * GRID, GRID)
    assert maps.dtype == np.float32
    assert 0.7 < np.polyfit(POSITIONS.T.ravel(), (maps + REFERENCE).ravel(), 1)[0] < 1.2
    assert own.tool.last.valid.all()


def test_only_valid_subapertures_are_measured() -> None:
    valid = np.ones((2 * GRID, GRID), bool)
    valid[1, 2] = valid[GRID + 1, 2] = False
    own, everything = measuring(), measuring()
    frame = frame_of(images())
    maps = own.maps(process(valid_sub_aps=valid), frame, no_stream)
    expected = np.where(valid, everything.maps(process(), frame, no_stream), 0.0)
    np.testing.assert_allclose(maps, expected, atol=1e-6)
    assert len(own.tool.pipeline.layout) == N - 1
    assert len(everything.tool.pipeline.layout) == N
    own.maps(process(), frame, no_stream)  # the mask may change
    assert len(own.tool.pipeline.layout) == N


def test_frames_without_flux() -> None:
    own = measuring()
    np.testing.assert_array_equal(own.maps(process(), np.zeros((30, 30)), no_stream), 0.0)
    stack = images()
    stack[4] = 0.0
    maps = own.maps(process(), frame_of(stack), no_stream)
    assert maps[1, 1] == maps[GRID + 1, 1] == 0.0


def test_predicted_slopes_come_by_a_stream() -> None:
    true = POSITIONS.T.reshape(2 * GRID, GRID) - REFERENCE
    frame = frame_of(noisy(np.random.default_rng(1), 5.0))
    errors = []
    for stream in (Stream(true.ravel(), 0), Stream(true.ravel(), 1)):
        own = measuring("map", input_streams={"predicted": "name"})
        own.parts.settings = own.parts.settings.replace(flux_e=5.0, prior_std_px=0.1)
        errors.append(np.std(own.maps(process(), frame, lambda name, stream=stream: stream) - true))
    assert errors[1] < 0.3 * errors[0]
    own = measuring("map", input_streams={"predicted": "name"})
    own.maps(process(), frame, no_stream)  # whoever predicts has not begun
    with refused("stream name", "18", "4"):
        own.maps(process(), frame, lambda name: Stream(np.zeros(4)))


def test_refused_in_one_line() -> None:
    with refused("slopes.faintspot"):
        _Measuring({})
    with refused("slopes: no"):
        _ = measuring().tool
    with pytest.raises(AttributeError, match="no attribute 'Slopes'"):
        _ = pyrtc.Slopes
    with refused("10 px", "30 x 30", "got 3", "row 2, column 0"):
        measuring().maps(process(offset_y=1), frame_of(images()), no_stream)


def test_maps_of_another_system() -> None:
    for name, value, message in (
        ("valid_sub_aps", np.ones((6, 4), bool), "expected shape (6, 3) for 3 x 3"),
        ("valid_sub_aps", np.zeros((6, 3), bool), "expected at least one valid"),
        ("ref_slopes", np.zeros((4, 2)), "expected shape (6, 3)"),
        ("ref_slopes", np.full((6, 3), np.nan), "expected finite numbers, got 18"),
    ):
        with refused(f"{name}: {message}"):
            measuring().maps(process(**{name: value}), frame_of(images()), no_stream)
    own = measuring()
    with refused("frame", "(2, 30, 30)"):
        own.maps(process(), np.ones((2, 30, 30)), no_stream)
    own.maps(process(), frame_of(images()), no_stream)
    with refused("frame", "(30, 30)", "(40, 30)"):
        own.maps(process(), np.ones((40, 30)), no_stream)


@needs("pyrtc", "pyrtc")
@pytest.mark.filterwarnings("ignore")
def test_signals_are_pyrtcs_own() -> None:
    from pyrtc import SlopesProcess, clear_shms, create_stream
    from pyrtc.component_loading import resolve_class_symbol

    pyrtc.slopes_process.cache_clear()
    ours = resolve_class_symbol("faintspot.adapters.pyrtc.FaintspotSlopes")
    assert issubclass(ours, SlopesProcess)
    name, stack = uuid4().hex[:8], images()
    streams = {stream: f"faintspot_{name}_{stream}" for stream in ("wfs", "signal", "signal_2d")}
    frame = frame_of(np.maximum(stack, 0.0)).astype(np.float32)
    camera = create_stream(streams["wfs"], frame.shape, np.float32)
    configuration: dict[str, Any] = {
        "type": "SHWFS",
        "signal_type": "slopes",
        "sub_ap_spacing": SIDE,
        "functions": [],
    }
    configuration |= {"sub_ap_offset_x": 0, "sub_ap_offset_y": 0}
    configuration |= {"input_streams": {"wfs": streams.pop("wfs")}, "output_streams": streams}
    found = []
    try:
        for kind in (SlopesProcess, ours):
            component = kind({**configuration, "faintspot": {"estimator": {"name": "centroid"}}})
            component.set_ref_slopes(REFERENCE)
            camera.write(frame)
            component.compute_signal()
            found.append(np.array(component.read(block=False)))
            component.close()
    finally:
        clear_shms([*streams.values(), *configuration["input_streams"].values()])
    # The same pixels are summed in float32.
    np.testing.assert_allclose(found[1], found[0], atol=1e-5)
    assert np.ptp(found[0]) > 1.0


class SlopesStandIn:
    """Stand-in of pyRTC's SlopesProcess: the signal has the slopes of the valid sub-apertures."""

    valid_sub_aps: np.ndarray

    def __init__(self, conf: dict[str, Any]) -> None:
        vars(self).update(vars(process()))
        self.valid_sub_aps[[1, GRID + 1], 2] = False

    def compute_signal(self, image: np.ndarray) -> None:
        maps: np.ndarray = self._compute_slopes_shwfs(image)  # type: ignore[attr-defined]
        self.signal: np.ndarray = maps[self.valid_sub_aps]

    def read(self, *, block: bool) -> np.ndarray:
        assert not block
        return self.signal


def test_a_recording_has_no_slopes_that_were_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are 0 in the stream."""
    tool = SimpleNamespace(SlopesProcess=SlopesStandIn, open_stream=no_stream)
    monkeypatch.setattr(pyrtc, "_pyrtc", lambda: tool)
    tables = {**TABLES, **ESTIMATORS["centroid"].to_tables()}
    component = pyrtc.slopes_process.__wrapped__()({"faintspot": tables})
    with refused("no frame has been measured yet"):
        component.recorded()
    stack = images()
    stack[4] = 0.0
    component.compute_signal(frame_of(stack))
    dark = [4, N - 1 + 4]  # before the one that is not valid
    assert not component.signal[dark].any()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(component.recorded())), dark)
    np.testing.assert_array_equal(np.nan_to_num(component.recorded()), component.signal)


class LoopStandIn:
    """Stand-in of pyRTC's Loop: signals in a list, None where its input is stale."""

    def __init__(self, conf: dict[str, Any]) -> None:
        self.flat, self.signals = np.zeros((3, 1), np.float32), list(conf["signals"])
        self.sent: list[np.ndarray] = []

    def _read_signal(self) -> Any:
        return self.signals.pop(0)

    def read_stream(self, name: str, *, block: bool) -> np.ndarray:
        assert (name, block) == ("wfc", False)
        return np.full((3, 1), 7.0, np.float32)

    def send_to_wfc(self, command: np.ndarray, slopes: Any) -> None:
        self.sent.append(command)


class ControllerStandIn:
    """Controller that adds the sum of the slopes to its command."""

    def reset(self, command: np.ndarray) -> None:
        self.command = command.astype(np.float64)

    def __call__(self, slopes: np.ndarray) -> np.ndarray:
        self.command = self.command + slopes.sum()
        return self.command

    def prepare(self) -> None:
        self.is_prepared = True


def test_a_loop_with_the_predictive_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts from the mirror as it is; without a signal nothing is sent."""
    monkeypatch.setattr(pyrtc, "_pyrtc", lambda: SimpleNamespace(Loop=LoopStandIn))
    signals = [np.ones(4, np.float32), None, np.ones((4, 1), np.float32)]
    loop = pyrtc.loop.__wrapped__()({"signals": signals})
    with refused("loop.controller"):
        loop.predictive_filter()
    loop.controller = ControllerStandIn()
    for _ in signals:
        loop.predictive_filter()
    assert [command.tolist() for command in loop.sent] == [[11.0] * 3, [15.0] * 3]
    assert loop.sent[0].dtype == np.float32
    assert loop.controller.is_prepared
