import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
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
from faintspot.adapters import soapy


class StandIn:
    """What an adapter asks of soapy's sensor: a centroider by name, half a window and static slopes off."""

    n_subaps, nx_subap_pixels, iMat = N, SIDE, False

    def __init__(self) -> None:
        self.config = SimpleNamespace(centMethod="own", photonNoise=False, eReadNoise=0)
        self.centSubapArrays = images(7.0, np.zeros((N, 2)))
        self.staticData: Any = None
        self.slopes = np.zeros(2 * N)

    def getStatic(self) -> None:
        self.staticData = None
        self.staticData = self.measure(images(7.0, np.zeros((N, 2)))).reshape(2, N)

    def measure(self, frame: Any) -> np.ndarray:
        centroider = getattr(sys.modules[__name__ + "_wfs"].centroiders, self.config.centMethod)
        found = np.nan_to_num(centroider(frame, threshold=0.1, ref=None)) - SIDE / 2
        return np.ravel(found if self.staticData is None else found - self.staticData)


@pytest.fixture
def wfs(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    module = ModuleType(__name__ + "_wfs")
    module.centroiders = SimpleNamespace(own=lambda images, **_: np.zeros((2, N)))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(StandIn, "__module__", module.__name__)
    return StandIn()


@pytest.mark.parametrize("name", ["tv", "window", "map"])
def test_every_estimator_has_the_tools_unit_and_order(wfs: StandIn, name: str) -> None:
    soapy.attach(wfs, ESTIMATORS[name], READ_NOISE, psf=PSF)
    wfs.iMat, wfs.config.eReadNoise = True, 1.0  # a frame of an interaction matrix
    slopes = wfs.measure(images(5e5))
    # Gains of the estimators, for spots up to 1 px away: 0.7 to 1.2 (see test_base).
    assert 0.7 < np.polyfit(POSITIONS.T.ravel(), slopes, 1)[0] < 1.2
    assert np.abs(wfs.measure(images(5e5, np.zeros((N, 2))))).max() < 1e-3


def test_predicted_slopes(wfs: StandIn) -> None:
    asked: list[np.ndarray] = []

    def predict(last: np.ndarray) -> np.ndarray:
        asked.append(last)
        return POSITIONS.T.ravel()

    settings = Settings("map", flux_e=FAINT_E, prior_std_px=0.05)
    attached = soapy.attach(wfs, settings, READ_NOISE, psf=PSF, predict=predict)
    wfs.config.photonNoise = True
    rng = np.random.default_rng(1)
    first, second = (wfs.measure(noisy(rng)) for _ in range(2))
    assert len(asked) == 1
    np.testing.assert_allclose(asked[0].ravel(), first, atol=1e-12)
    assert np.abs(second - POSITIONS.T.ravel()).max() < 0.1  # two widths of the prior
    with attached.calibrating():
        wfs.measure(images())
    assert attached.measured.last.valid.all()


def test_a_spot_without_flux_has_slope_zero(wfs: StandIn) -> None:
    attached = soapy.attach(wfs, EVERYTHING)
    wfs.config.photonNoise = True
    frame = images()
    frame[2] = 0.0
    slopes = wfs.measure(frame).reshape(2, N)
    assert not attached.measured.last.valid[2]
    np.testing.assert_allclose(slopes[:, 2], 0.0, atol=1e-12)
    assert np.abs(slopes[:, 3]).max() > 0.1


def test_attach_and_detach(wfs: StandIn) -> None:
    attached = soapy.attach(wfs, EVERYTHING)
    before = images()
    wfs.measure(before)
    np.testing.assert_array_equal(before, images())  # soapy's images are not changed
    with refused("soapy's images: expected shape (9, 10, 10), got (9, 4, 4)"):
        wfs.measure(np.ones((N, 4, 4)))
    with refused("got (8, 10, 10); attach faintspot again after changing the sensor"):
        wfs.measure(images()[1:])
    attached.detach()
    assert wfs.config.centMethod == "own"
    np.testing.assert_array_equal(wfs.measure(before), 0.0)
    with refused("expected soapy's ShackHartmann, got SimpleNamespace"):
        soapy.attach(SimpleNamespace(), EVERYTHING)


def test_a_dark_sensor_keeps_its_own_centroider(wfs: StandIn, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wfs, "getStatic", lambda: wfs.measure(np.zeros((N, SIDE, SIDE))))
    with refused("expected flux in the sub-apertures"):
        soapy.attach(wfs, EVERYTHING)
    assert wfs.config.centMethod == "own"


SYSTEM = """
simName:
pupilSize: 40
nGS: 1
nDM: 1
nSci: 1
nIters: 5
loopTime: 0.004
threads: 1
Atmosphere: {scrnNo: 1, scrnHeights: [0], scrnStrengths: [1.0], windDirs: [0], windSpeeds: [10], r0: 0.15,
  wholeScrnSize: 256, infinite: false}
Telescope: {telDiam: 3.0, obsDiam: 0.0, mask: circle}
WFS:
  0: {type: ShackHartmann, GSMag: 8, GSPosition: [0, 0], GSHeight: 0, wavelength: 650.0e-9, nxSubaps: 5,
    pxlsPerSubap: 10, subapFOV: 2.5, subapThreshold: 0.5, photonNoise: true, eReadNoise: 1.0,
    propagationMode: Geometric, exposureTime: 0.004}
DM:
  0: {type: GaussStack, nxActuators: 6, svdConditioning: 0.05, gain: 0.5}
Reconstructor: {type: MVM, svdConditioning: 0.05, gain: 0.5, imatValue: 20}
Science:
  0: {type: PSF, wavelength: 1.65e-6, FOV: 2.0, pxls: 32, position: [0, 0]}
"""


@needs("soapy", "soapy")
@pytest.mark.filterwarnings("ignore")
def test_interaction_matrix_is_soapys(tmp_path: Path) -> None:
    import soapy as tool

    path = tmp_path / "system.yaml"
    path.write_text(SYSTEM)
    simulation = tool.Sim(str(path))
    simulation.aoinit()
    wfs = simulation.wfss[0]
    simulation.makeIMat(forceNew=True)
    own = np.array(simulation.recon.interaction_matrix)
    attached = soapy.attach(wfs, Settings("centroid"))
    simulation.makeIMat(forceNew=True)
    ours = np.array(simulation.recon.interaction_matrix)
    assert attached.measured.last.valid.all()
    # The same pixels are summed: float32 pixels against float64.
    np.testing.assert_allclose(ours, own, atol=1e-4 * np.abs(own).max())
