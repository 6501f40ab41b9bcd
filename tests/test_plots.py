"""Objects draw themselves, on given axes or new ones, with the content of the pages."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.quiver import Quiver
from tests.loop.telemetry.loop_cases import recorded
from tests.refusals import refused

import faintspot as fs
from faintspot.experiments import StudySpecification, Sweep, WorkerPool, run
from faintspot.slopes.simulate import sensor_frames

LAYOUT = fs.Layout.grid((6, 6), pixels=12)
FRAMES, _ = sensor_frames(LAYOUT, 3, flux_e=500.0, rng=np.random.default_rng(1))
FRAMES[:, :12, :12] = 0.0


def measured(frames: Any) -> fs.Slopes:
    return fs.SlopePipeline(LAYOUT, fs.Settings("brightest", keep_brightest=12))(frames)


@pytest.fixture(scope="module")
def slopes() -> fs.Slopes:
    return measured(FRAMES)


@pytest.fixture
def axes() -> Any:
    """Make axes with the user's own style, and close all figures afterwards."""
    pyplot.switch_backend("Agg")
    yield pyplot.figure().add_subplot()
    pyplot.close("all")


def of_kind(axes: Axes, kind: type) -> list[Any]:
    """Return what was drawn of a kind."""
    return [child for child in axes.get_children() if isinstance(child, kind)]


def test_a_layout_draws_its_windows_on_a_frame_or_alone(axes: Axes) -> None:
    assert LAYOUT.plot(FRAMES, axes) is axes
    (windows,) = of_kind(axes, PolyCollection)
    np.testing.assert_allclose(
        [path.vertices[0] for path in windows.get_paths()], LAYOUT.corners[:, ::-1] - 0.5
    )
    shown = np.asarray(axes.images[0].get_array())
    np.testing.assert_allclose(shown, FRAMES.mean(axis=0), rtol=1e-4)  # of float32
    assert axes.images[0].origin == "lower"
    alone = LAYOUT.plot()
    assert alone is not axes
    assert len(of_kind(alone, PolyCollection)[0].get_paths()) == len(LAYOUT)
    with refused("frame"):
        LAYOUT.plot(FRAMES[:, 1:])


@pytest.mark.parametrize("frames", [FRAMES, FRAMES[0]], ids=["frames", "frame"])
def test_slopes_are_arrows_at_valid_sub_apertures(axes: Axes, frames: Any) -> None:
    slopes = measured(frames)
    assert slopes.plot(axes) is axes
    (arrows,) = of_kind(axes, Quiver)
    valid = np.atleast_2d(slopes.valid)
    np.testing.assert_allclose(arrows.XY, LAYOUT.centres[valid.any(axis=0)])
    assert not valid[:, 0].any()
    mean = np.atleast_2d(slopes.x).mean(axis=0)[1:]
    assert np.corrcoef(arrows.U, mean)[0, 1] > 0.99  # the longest are cut


def test_slopes_without_a_layout_need_one(axes: Axes, slopes: fs.Slopes) -> None:
    unknown = replace(slopes, layout=None)
    with refused("layout"):
        unknown.plot(axes)
    with refused("layout"):
        slopes.plot(axes, layout=LAYOUT[:5])
    assert unknown.plot(axes, layout=LAYOUT) is axes


def test_a_wavefront_is_drawn_over_its_pupil_with_and_without_tilt(axes: Axes, slopes: fs.Slopes) -> None:
    tilted = fs.Slopes.from_variables({**slopes.variables, "x": slopes.x + 1}, layout=LAYOUT)
    wavefront = fs.fit_wavefront(tilted, LAYOUT, modes=6)
    for tilt in (True, False):
        sheet: Any = np.ma.filled(
            np.ma.asarray(wavefront.plot(axes, tilt=tilt).images[-1].get_array()), np.nan
        )
        np.testing.assert_array_equal(sheet, wavefront.sheet(tilt=tilt))
    assert len(of_kind(axes, PolyCollection)[0].get_paths()) == len(wavefront.outlines)
    assert len(repr(wavefront)) < 300


def test_a_psf_is_drawn_about_the_spot(axes: Axes) -> None:
    psf = fs.PSF.analytic(size=[1.0, 2.0], index=[0, 1])
    assert psf.plot(axes, which=1) is axes
    image = axes.images[0]
    np.testing.assert_array_equal(image.get_array(), psf.samples[1])
    left, right, low, high = image.get_extent()
    assert left == -right < 0 < high == -low
    with refused("which"):
        psf.plot(axes, which=2)


@pytest.mark.slow  # which measures its delay
def test_a_recording_draws_the_noise_of_x_and_y(axes: Axes) -> None:
    recording = recorded(frames=500)
    places = recording.plot()
    noise = np.array([place.images[0].get_array() for place in places])
    assert noise.shape == (2, 5, 5)
    assert 0.25 < np.sqrt(np.square(noise).mean()) < 0.35  # true: .3
    with refused("axes"):
        recording.plot(axes)
    assert len(repr(recording)) < 300


@pytest.mark.slow
def test_a_study_draws_its_figures(axes: Axes) -> None:
    light = Sweep("light", flux_e=[30, 100, 300], pixels=8)
    specification = StudySpecification(
        "mine", [light], realisations=50, estimators=["brightest", "tv"], fixed_k=[]
    )
    dataset = run(specification, pool=WorkerPool(workers=0))
    places = np.ravel(dataset.faintspot.plot())
    assert "TV" in [text.get_text() for text in places[0].get_legend().get_texts()]
    with refused("figure"):
        dataset.faintspot.plot("none", axes)
