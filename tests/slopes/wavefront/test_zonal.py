"""Zonal maps against wavefronts that are known, on whole, obstructed and disconnected pupils."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.slopes.wavefront.test_fit import LAYOUT, SCALED, flagged, slopes_of, slopes_of_modes

from faintspot import InputError, Layout, fit_wavefront
from faintspot.slopes.wavefront.files import zonal_remarks, zonal_table
from faintspot.slopes.wavefront.zernike import zernike
from faintspot.slopes.wavefront.zonal import ZonalMap, compared, zonal_map

LARGE = Layout.grid((20, 20), pixels=8, outer_radius=10, inner_radius=2)
SPLIT = LARGE[LARGE.cells[:, 1] != 9]
HEXAGONAL = replace(LAYOUT, geometry="hexagonal", angle_deg=3.0)


def true_values(found: ZonalMap, layout: Layout, coefficients: NDArray[Any]) -> NDArray[np.float64]:
    """Return the wavefront at the centres minus its mean over each part."""
    x, y = (layout.centres - found.pupil.centre_px).T / found.pupil.radius_px
    values = sum(value * zernike(j, x, y) for j, value in enumerate(coefficients, start=2))
    means = (np.bincount(found.parts, values) / np.bincount(found.parts))[found.parts]
    return np.asarray((values - means) * found.pupil.radius_subapertures)


@pytest.mark.parametrize(
    ("layout", "modes", "limit"),
    # Second order exactly; third on 7 sub-apertures and sixth on 20 with the error of the splines.
    [(LAYOUT, 5, 1e-5), (LAYOUT, 9, 0.01), (HEXAGONAL, 9, 0.01), (LARGE, 27, 0.02), (SPLIT, 27, 0.02)],
)
def test_smooth_wavefronts_come_back(layout: Layout, modes: int, limit: float) -> None:
    coefficients = np.random.default_rng(1).normal(size=modes)
    found = zonal_map(slopes_of(slopes_of_modes(layout, coefficients[None])), layout)
    truth = true_values(found, layout, coefficients)
    assert np.std(found.values - truth) < limit * np.std(truth)


def test_parts_that_are_not_connected_have_means_of_their_own() -> None:
    slopes = slopes_of(slopes_of_modes(SPLIT, np.array([[5.0, 1.0, 0.5]])))
    found, modes = zonal_map(slopes, SPLIT), fit_wavefront(slopes, SPLIT)
    assert np.bincount(found.parts).tolist() == [152, 136]
    for part in (0, 1):
        assert found.values[found.parts == part].mean() == pytest.approx(0, abs=1e-9)
    assert "2 parts without a common edge (152, 136 sub-apertures)" in " ".join(zonal_remarks(found, modes))
    sheets = compared(found, modes)
    assert np.nanstd(sheets["zonal map minus modes"]) < 1e-4 * np.nanstd(sheets["zonal map"])
    flat = found.centred(found.sheet, tilt=False)
    assert np.nanstd(flat) < 0.2 * np.nanstd(found.sheet)
    assert [row[0] for row in zonal_table(found, modes)[1]] == list(sheets)


def test_subapertures_that_touch_at_a_corner_are_not_connected() -> None:
    layout = LARGE[(LARGE.cells < 10).all(axis=1) | (LARGE.cells >= 10).all(axis=1)]
    found = zonal_map(slopes_of(np.zeros((1, 2, len(layout)))), layout)
    assert np.bincount(found.parts).tolist() == [len(layout) // 2] * 2


@pytest.mark.parametrize("layout", [LAYOUT[LAYOUT.cells[:, 1] != 3], HEXAGONAL])
def test_standard_errors_are_those_of_the_scatter(layout: Layout) -> None:
    rng = np.random.default_rng(2)
    error = rng.uniform(0.05, 0.5, len(layout))
    noise = rng.normal(size=(300, 2, len(layout))) * error
    known = [zonal_map(_with_errors(noise[number : number + 1], error), layout) for number in range(40)]
    scatter = np.std([found.values for found in known], axis=0)
    # 40 draws: 11 % of error of each, less in the mean over sub-apertures.
    assert np.mean(known[0].standard_errors / scatter) == pytest.approx(1, abs=0.08)
    plain = np.std([zonal_map(slopes_of(noise[number : number + 1]), layout).values for number in range(12)])
    assert np.sqrt(np.mean(scatter**2)) < plain  # weights help
    over_frames = zonal_map(_with_errors(noise, error), layout)
    ratio = over_frames.standard_errors * np.sqrt(300) / known[0].standard_errors
    assert np.mean(ratio) == pytest.approx(1, abs=0.06)
    assert [found.errors_from for found in (known[0], over_frames)] == ["slopes", "frames"]


def _with_errors(noise: NDArray[Any], error: NDArray[Any]) -> Any:
    slopes = slopes_of(noise)
    errors = np.broadcast_to(error, slopes.x.shape).astype(np.float32)
    return replace(slopes, standard_error_x=errors, standard_error_y=errors)


def test_errors_from_residuals() -> None:
    noise = np.random.default_rng(5).normal(scale=0.1, size=(1, 2, len(LARGE)))
    unknown = zonal_map(slopes_of(noise), LARGE)
    known = zonal_map(slopes_of(noise, 0.1), LARGE)
    assert unknown.errors_from == "residuals"
    np.testing.assert_allclose(unknown.standard_errors, known.standard_errors, rtol=0.1)
    np.testing.assert_allclose(unknown.values, known.values)


def test_slopes_that_no_surface_has_are_left() -> None:
    """Slopes around the middle, of 1 px at a radius of 5 sub-apertures."""
    y, x = (LARGE.cells - 9.5).T / 5
    found = zonal_map(slopes_of(np.stack([-y, x])[None]), LARGE)
    assert found.residual_px == pytest.approx(np.sqrt(np.mean((x**2 + y**2) / 2)), rel=0.03)


def test_units_and_map() -> None:
    slopes = slopes_of(slopes_of_modes(SCALED, np.array([[0.4, 0.0, 0.2, 0.0, 0.0]])))
    found, modes = zonal_map(slopes, SCALED), fit_wavefront(slopes, SCALED, modes=5)
    assert found.unit == "nm"
    assert np.nanstd(compared(found, modes)["zonal map minus modes"]) < 1e-4 * np.nanstd(found.sheet)
    um = found.in_unit("um")
    np.testing.assert_allclose(1e3 * um.sheet, found.sheet)
    np.testing.assert_allclose(1e3 * um.values, found.values)
    middle = found.nearest[100, 100]
    assert middle == -1  # the central obscuration
    shown = found.nearest == 0
    assert np.count_nonzero(shown) > 100
    assert np.isfinite(found.sheet[found.nearest >= 0]).all()
    assert np.isnan(found.sheet[found.nearest < 0]).all()


def test_corners_of_a_square_array_are_in_the_map() -> None:
    layout = replace(Layout.grid((7, 7), pixels=8), angle_deg=0.0)
    found = zonal_map(slopes_of(np.ones((1, 2, len(layout)))), layout)
    assert np.isfinite(found.values).all()
    assert found.values[-1] - found.values[0] == pytest.approx(12, abs=1e-3)


def test_seldom_valid_subapertures_are_left_out() -> None:
    slopes = flagged(slopes_of(np.ones((10, 2, len(LAYOUT)))), (slice(0, 8), 3))
    found = zonal_map(slopes, LAYOUT)
    assert np.flatnonzero(np.isnan(found.values)).tolist() == [3]
    assert "valid in less than half of the frames" in found.left_out


def test_a_subaperture_alone_has_a_tilt() -> None:
    layout = LAYOUT[[0, 1, 35]]
    found = zonal_map(slopes_of(np.ones((1, 2, 3)), 0.1), layout)
    assert found.parts.tolist() == [0, 0, 1]
    assert found.values == pytest.approx([-0.5, 0.5, 0.0], abs=1e-3)


def test_bad_input() -> None:
    slopes = slopes_of(np.zeros((2, 2, len(LAYOUT))))
    with pytest.raises(InputError, match="expected 35 sub-apertures, as in the layout, got 36"):
        zonal_map(slopes, LAYOUT[1:])
    with pytest.raises(InputError, match="expected at least 3 valid sub-apertures for a wavefront, got 0"):
        zonal_map(flagged(slopes, slice(None)), LAYOUT)
