"""Slopes of frames say what they are."""

import re
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

import faintspot as fs
from faintspot import Calibration, Layout, MissingExtraError, Settings, SlopePipeline, Slopes
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.simulate import sensor_frames

LAYOUT = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, inner_radius=0.5)


def slopes_of(*shape: int) -> fs.Slopes:
    frames = np.random.default_rng(1).poisson(20.0, (*shape, *LAYOUT.frame_shape)).astype(np.float32)
    return fs.SlopePipeline(LAYOUT, fs.Settings("brightest", keep_brightest=9))(frames)


def test_slopes_say_what_they_are_in_one_line() -> None:
    expected = r"frames 1, sub-apertures 36, valid 100 %, rms of x, y [\d.]+, [\d.]+ px, median flux \d+ e-"
    assert re.fullmatch(rf"Slopes\({expected}\)", repr(slopes_of()))
    assert "frames 4" in repr(slopes_of(4))
    dark = fs.SlopePipeline(LAYOUT, fs.Settings("brightest"))(np.zeros(LAYOUT.frame_shape, np.float32))
    assert repr(dark) == "Slopes(frames 1, sub-apertures 36, valid 0 %)"


SCALED_LAYOUT = Layout.grid((2, 3), pixels=8, pixel_scale_arcsec=0.5)


@pytest.fixture(scope="module")
def slopes() -> Slopes:
    frames, _ = sensor_frames(SCALED_LAYOUT, 4, rng=np.random.default_rng(1))
    settings, noise = Settings(estimator="brightest", keep_brightest=8), Calibration(read_noise_e=1.0)
    return SlopePipeline(SCALED_LAYOUT, settings, noise)(frames)


def test_a_dataset_has_names_and_units(slopes: Slopes) -> None:
    pytest.importorskip("xarray")
    dataset = slopes.to_xarray(SCALED_LAYOUT, unit="arcsec")
    assert dict(dataset.sizes) == {"frame": 4, "subaperture": 6}
    np.testing.assert_allclose(dataset.x, 0.5 * slopes.x)
    assert slopes.covariance_xy.any()
    np.testing.assert_allclose(dataset.covariance_xy, 0.25 * slopes.covariance_xy)
    np.testing.assert_array_equal(dataset.valid, slopes.valid)
    np.testing.assert_array_equal(dataset.centre_x, SCALED_LAYOUT.centres[:, 0])
    assert [dataset[name].attrs["units"] for name in ("x", "covariance_xy", "flux", "centre_y")] == [
        "arcsec",
        "arcsec^2",
        "e-",
        "px",
    ]
    in_px = slopes.to_xarray()
    np.testing.assert_array_equal(in_px.x, slopes.x)
    assert in_px.x.attrs["units"] == in_px.attrs["unit"] == "px"


def test_a_table_has_a_row_for_each_slope(slopes: Slopes) -> None:
    pytest.importorskip("pandas")
    table = slopes.to_pandas(SCALED_LAYOUT)
    assert table.index.names == ["frame", "subaperture"]
    assert table.loc[(3, 5), "y_px"] == slopes.y[3, 5]
    assert table.loc[(3, 5), "centre_x_px"] == SCALED_LAYOUT.centres[5, 0]
    table = slopes.to_pandas(SCALED_LAYOUT, unit="arcsec")
    assert table.loc[(2, 1), "x_arcsec"] == 0.5 * slopes.x[2, 1]
    assert table.loc[(2, 1), "covariance_xy_arcsec2"] == 0.25 * slopes.covariance_xy[2, 1]
    one = replace(slopes, **{name: getattr(slopes, name)[0] for name in SlopeArrays._fields})
    assert len(one.to_pandas()) == 6


def test_unknown_units_other_layouts_and_missing_packages_are_refused(
    slopes: Slopes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with refused("pixel_scale_arcsec"):
        slopes.to_pandas(replace(SCALED_LAYOUT, pixel_scale_arcsec=None), unit="arcsec")
    with refused("expected 6 sub-apertures"):
        slopes.to_pandas(SCALED_LAYOUT[1:])
    assert_each_refused(partial(slopes.to_pandas, SCALED_LAYOUT), unit=["mas"])
    for name in ("xarray", "pandas"):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(MissingExtraError):
            getattr(slopes, f"to_{name}")()
