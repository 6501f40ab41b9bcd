import importlib.metadata
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tests.adapters.adapter_cases import (
    ESTIMATORS,
    EVERYTHING,
    FAINT_E,
    POSITIONS,
    PSF,
    READ_NOISE,
    SIDE,
    N,
    images,
    needs,
    noisy,
)
from tests.refusals import refused

from faintspot import Settings
from faintspot.adapters import oopao
from faintspot.adapters.base import UntestedVersionWarning, check_version


class StandIn:
    """What an adapter asks of OOPAO's sensor; its spots are at POSITIONS, times a number."""

    tag, is_geometric, n_pix_subap, threshold_cog = "shackHartmann", False, SIDE, 0.01

    def __init__(self, sources: tuple[int, ...] = (N,)) -> None:
        self.cam = SimpleNamespace(photonNoise=0, readoutNoise=0)
        constants: Any = {"weighting_map": 1, "reference_signal_2D": 0}
        self.sh_data = {
            f"src_{i}": SimpleNamespace(
                **constants, nValidSubaperture=n, valid_signal_2D=np.ones((2, n), bool)
            )
            for i, n in enumerate(sources)
        }
        self.slopes_units: Any = 1.0

    def centroid(self, image: Any, threshold: float) -> Any:
        raise AssertionError("OOPAO's own")

    def wfs_integrate(self, src: Any, sh_data: Any) -> Any:
        """Return places less references over the unit, as OOPAO does: all along rows first."""
        found = self.centroid(src[: sh_data.nValidSubaperture], self.threshold_cog)
        reference = np.asarray(sh_data.reference_signal_2D)
        return (found.T - reference) / self.slopes_units

    def initialize_wfs(self) -> None:
        self.slopes_units = 1.0
        for data in self.sh_data.values():
            data.reference_signal_2D = 0
            data.reference_signal_2D = self.wfs_integrate(images(7.0, np.zeros((N, 2))), data)
        tilted = images(7.0, np.ones((N, 2)))
        self.slopes_units = float(np.mean(self.wfs_integrate(tilted, self.sh_data["src_0"])))


def signal(wfs: StandIn, frame: Any, source: int = 0) -> np.ndarray:
    return np.asarray(wfs.wfs_integrate(src=frame, sh_data=wfs.sh_data[f"src_{source}"]))


def test_slopes_have_the_tools_unit_and_order(monkeypatch: pytest.MonkeyPatch) -> None:
    wfs = StandIn()
    check_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "99.0")
    with pytest.warns(UntestedVersionWarning, match=f"OOPAO 99.0: .* tested with {oopao.TESTED}; compare"):
        oopao.attach(wfs, ESTIMATORS["window"], READ_NOISE, psf=PSF)
    check_version.cache_clear()
    # Noise-free, at the flux of calibrations: the unit has taken the estimator's gain out.
    rows, columns = signal(wfs, images(5e5))
    assert np.polyfit(POSITIONS[:, 1], rows, 1)[0] == pytest.approx(1.0, abs=0.15)
    assert np.polyfit(POSITIONS[:, 0], columns, 1)[0] == pytest.approx(1.0, abs=0.15)
    assert abs(wfs.slopes_units) > 0.5


def test_noise_switches_calibration_off_and_prediction_on() -> None:
    wfs, asked = StandIn(), []

    def predict(last: np.ndarray) -> np.ndarray:
        asked.append(last.copy())
        return np.concatenate([POSITIONS[:, 1], POSITIONS[:, 0]])

    settings = Settings("map", flux_e=FAINT_E, prior_std_px=0.05)
    attached = oopao.attach(wfs, settings, READ_NOISE, psf=PSF, predict=predict)
    assert not asked  # references and units are not predicted
    wfs.cam.photonNoise, wfs.cam.readoutNoise = True, 1.0
    rng = np.random.default_rng(1)
    first, second = (signal(wfs, noisy(rng)) for _ in range(2))
    np.testing.assert_allclose(asked, [first.ravel()])
    # The prior is where the spots are, and says far more than 40 electrons: within 2 of its widths.
    assert np.abs(second - POSITIONS[:, ::-1].T).max() < 0.1
    assert np.abs(first - POSITIONS[:, ::-1].T).max() > 0.2  # the first had one of 0
    assert attached.measured[0].last.valid.all()
    with attached.calibrating(500.0):
        signal(wfs, images())
    assert len(asked) == 1


def test_predictions_are_in_the_tools_unit_and_from_its_references() -> None:
    """Places are predictions times the unit, plus the reference; 5 e- say little against 0.02 px."""
    wfs: Any = StandIn()
    predicted = np.random.default_rng(2).uniform(-0.2, 0.2, 2 * N)
    settings = Settings("map", flux_e=5.0, prior_std_px=0.02)
    oopao.attach(wfs, settings, READ_NOISE, psf=PSF, predict=lambda last: predicted)
    wfs.cam.photonNoise, wfs.slopes_units = True, 3.0
    wfs.sh_data["src_0"].reference_signal_2D += np.array([[0.3], [-0.2]])
    rng = np.random.default_rng(1)
    signal(wfs, noisy(rng, 5.0))
    np.testing.assert_allclose(signal(wfs, noisy(rng, 5.0)).ravel(), predicted, atol=0.02)


def test_a_spot_without_flux_has_slope_zero() -> None:
    wfs: Any = StandIn()
    attached = oopao.attach(wfs, EVERYTHING)
    wfs.sh_data["src_0"].reference_signal_2D += 0.3
    frame = images()
    frame[2] = 0.0
    found = signal(wfs, frame)
    np.testing.assert_allclose(found[:, 2], 0.0, atol=1e-12)
    wfs.signal = found.ravel()
    recorded = np.where(np.arange(N) == 2, np.nan, found)
    np.testing.assert_array_equal(attached.recorded(), recorded.ravel())
    assert np.abs(found[:, 3]).max() > 0.1


def test_sources_with_other_numbers_of_subapertures() -> None:
    wfs = StandIn((N, 4))
    attached = oopao.attach(wfs, EVERYTHING)
    assert signal(wfs, images(), 1).shape == (2, 4)
    assert [len(each.pipeline.layout) for each in attached.measured] == [N, 4]
    np.testing.assert_allclose(signal(wfs, images())[:, :4], signal(wfs, images(), 1), atol=1e-6)


def test_sensors_that_are_refused() -> None:
    other, geometric, weighted, dark = (StandIn() for _ in range(4))
    other.tag, geometric.is_geometric = "pyramid", True
    weighted.sh_data["src_0"].weighting_map = np.full((N, SIDE, SIDE), 0.5)
    vars(dark)["initialize_wfs"] = lambda: signal(dark, np.zeros((N, SIDE, SIDE)))
    predict: Any = [None]
    for wfs, options, names in (
        (other, {}, ("ShackHartmann", "StandIn")),
        (geometric, {}, ("diffractive",)),
        (weighted, {}, ('"window"',)),
        (StandIn((N, N)), {"predict": predict}, ("2 sources", "1")),
        (dark, {}, ("flux",)),
    ):
        with refused(*names):
            oopao.attach(wfs, EVERYTHING, **options)
        assert "centroid" not in vars(wfs)  # OOPAO's own is in its place


def test_images_of_another_size_and_units_of_nothing() -> None:
    wfs = StandIn()
    oopao.attach(wfs, EVERYTHING)
    with refused("images", "(9, 10, 10)", "(9, 8, 8)"):
        signal(wfs, np.ones((N, 8, 8)))
    with refused("(8, 10, 10)"):
        wfs.centroid(images()[1:], 0.0)
    wfs.slopes_units, wfs.initialize_wfs = float("nan"), lambda: None  # type: ignore[method-assign]
    with refused("wfs.slopes_units", "nan"):
        oopao.attach(wfs, EVERYTHING)


@needs("OOPAO", "oopao")
@pytest.mark.filterwarnings("ignore")
class TestRealTool:
    @pytest.fixture(scope="class")
    def system(self) -> Any:
        from OOPAO.ShackHartmann import ShackHartmann
        from OOPAO.Source import Source
        from OOPAO.Telescope import Telescope

        telescope = Telescope(resolution=50, diameter=3.0, samplingTime=1 / 500, centralObstruction=0.2)
        star = Source(optBand="R", magnitude=8)
        star * telescope
        wfs = ShackHartmann(
            nSubap=5, telescope=telescope, lightRatio=0.5, shannon_sampling=True, threshold_cog=0
        )
        return SimpleNamespace(star=star, telescope=telescope, wfs=wfs)

    def slopes(self, system: Any, opd_m: Any) -> np.ndarray:
        from OOPAO.OPD_map import OPD_map

        system.star**system.telescope * OPD_map(opd_m) * system.wfs
        return np.array(system.wfs.signal)

    def test_slopes_and_interaction_matrix_are_oopaos(self, system: Any) -> None:
        rng = np.random.default_rng(1)
        pokes = [2e-6 * gaussian_filter(rng.normal(size=(50, 50)), 7) for _ in range(6)]
        own, unit = np.array([self.slopes(system, poke) for poke in pokes]), system.wfs.slopes_units
        attached = oopao.attach(system.wfs, Settings("centroid"))
        ours = np.array([self.slopes(system, poke) for poke in pokes])
        # The same pixels are summed: float32 pixels against float64.
        np.testing.assert_allclose(ours, own, atol=1e-4 * np.abs(own).max())
        assert np.abs(own).max() > 0.2
        assert system.wfs.slopes_units == pytest.approx(unit, rel=1e-5)
        attached.detach()
        np.testing.assert_allclose(self.slopes(system, pokes[0]), own[0], atol=1e-12)
