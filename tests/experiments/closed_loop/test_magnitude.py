import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.experiment_cases import HERE, SEARCH, StopsAfter, assert_same_files, small
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.experiments.closed_loop.magnitude import quick_run, run_magnitude
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.record import MAGNITUDE_FILE

skip_without("hcipy")
METHODS = ("centroid", "brightest")
LOOP = small().replace("run", frames=40)
PHOTONS = (400.0, 40.0)


def run(folder: Path, place: WorkerPool, methods: tuple[str, ...] = METHODS) -> MagnitudeResult:
    return run_magnitude(LOOP, folder, methods, PHOTONS, search=SEARCH, pool=place)


TOLD: list[tuple[int, int]] = []
"""Progress of the whole experiment."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("magnitude")
    run(folder, WorkerPool(0, progress=lambda done, total: TOLD.append((done, total))))
    return folder


@pytest.mark.slow
def test_the_result_has_an_entry_for_each_method_and_flux(whole: Path) -> None:
    """The progress is one of all stages."""
    result = MagnitudeResult.load(whole / MAGNITUDE_FILE)
    assert result.labels == ("centre of gravity", "brightest pixels")
    np.testing.assert_array_equal(result.photons, [40, 400])
    assert result.magnitudes[0] - result.magnitudes[1] == pytest.approx(2.5)
    assert result.strehl.shape == result.centroid_gain.shape == (2, 2, 2)
    assert (result.strehl[:, 1] > result.strehl[:, 0]).all()  # ten times the flux: 0.1 and more
    assert result.settings.shape == result.choices.shape == (2, 2)
    assert "keep_brightest" in result.settings[1, 0]
    done, total = np.transpose(TOLD)
    assert (np.diff(done) >= 0).all()
    assert done[-1] == total[-1]
    assert (total == total[0]).all()


@pytest.mark.slow
def test_interrupted_twice_and_started_again(tmp_path: Path, whole: Path) -> None:
    for calls in (2, 120):
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, WorkerPool(0, progress=StopsAfter(calls)))
    run(tmp_path, HERE)
    assert_same_files(tmp_path, whole)


@pytest.mark.slow
def test_methods_can_be_added(tmp_path: Path, whole: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "copy")
    one = run(folder, WorkerPool(0, progress=StopsAfter(0)), ("centroid",))  # nothing is left to do
    assert one.labels == ("centre of gravity",)
    both = run(folder, HERE)
    np.testing.assert_array_equal(both.strehl, MagnitudeResult.load(whole / MAGNITUDE_FILE).strehl)
    three = run(folder, HERE, (*METHODS, "window"))
    assert three.names == ("centroid", "brightest", "window")
    np.testing.assert_array_equal(three.strehl[:2], both.strehl)


def test_magnitude_without_methods_or_photons_is_refused(tmp_path: Path) -> None:
    for methods, photons, word in (((), PHOTONS, "methods"), (METHODS, None, "photons")):
        with refused(word):
            run_magnitude(small(), tmp_path, methods, photons, pool=HERE)
    with refused("photons"):
        run_magnitude(small(), tmp_path, METHODS, (0.0,), pool=HERE)
    assert quick_run(small()) == small()  # never longer
