"""Wavefronts against phases that are known: single modes, and screens of turbulence."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.refusals import refused

from faintspot import InputError, Layout, Settings, SlopePipeline, Slopes, SubapertureFlag, fit_wavefront
from faintspot.slopes.sensor.pupil import inside_pupil, lenslet_outlines, lit_outlines, pupil_of, side_m
from faintspot.slopes.wavefront.discrepancy import slope_discrepancy
from faintspot.slopes.wavefront.files import remarks
from faintspot.slopes.wavefront.zernike import mean_gradients, zernike

LAYOUT = Layout.grid((7, 7), pixels=8, outer_radius=3.5, inner_radius=0.5)
SCALED = replace(LAYOUT, pixel_scale_arcsec=0.4, diameter_m=4.2)
RAD = np.pi / (180 * 3600)


def slopes_of(xy: NDArray[Any], error: float = np.inf) -> Slopes:
    """Return slopes of positions (n_frames, 2, n), all valid."""
    x, y = np.moveaxis(np.asarray(xy, np.float32), -2, 0)
    zero = np.zeros(x.shape, np.int32)
    errors = np.full(x.shape, error, np.float32)
    return Slopes(x, y, np.ones_like(x), zero.astype(np.uint8), zero, zero, errors, errors, np.zeros_like(x))


def slopes_of_modes(layout: Layout, coefficients: NDArray[Any]) -> NDArray[np.float64]:
    """Return positions (frames, 2, n), px, of coefficients (frames, k) in px times radius of the disk."""
    pupil = pupil_of(layout)
    outlines = (lenslet_outlines(layout) - pupil.centre_px) / pupil.radius_px
    gradients = mean_gradients(np.arange(2, 2 + coefficients.shape[1]), outlines)
    positions: NDArray[np.float64] = np.einsum("ank,fk->fan", gradients, coefficients)
    return positions


def flagged(slopes: Slopes, where: Any) -> Slopes:
    flags = slopes.flags.copy()
    flags[where] = int(SubapertureFlag.NO_FLUX)
    return replace(
        slopes, flags=flags, x=np.where(flags > 0, 0, slopes.x), y=np.where(flags > 0, 0, slopes.y)
    )


@pytest.mark.parametrize("layout", [LAYOUT, replace(LAYOUT, geometry="hexagonal", angle_deg=3.0)])
def test_modes_come_back(layout: Layout) -> None:
    true = np.random.default_rng(1).normal(size=(5, 14))
    slopes = flagged(slopes_of(slopes_of_modes(layout, true)), (slice(1, 3), [0, 7]))
    found = fit_wavefront(slopes, layout)
    coefficients = found.coefficients / found.pupil.radius_subapertures
    np.testing.assert_allclose(coefficients[:, :14], true, atol=1e-5)
    np.testing.assert_allclose(coefficients[:, 14:], 0, atol=1e-5)
    assert found.unit == "px × sub-aperture"
    assert found.fitted.all()
    assert list(found.modes) == list(range(2, 29))


def test_errors_follow_correlated_noise() -> None:
    """Of spots elongated away from the middle; where all are alike, their covariances cancel in each mode."""
    rng = np.random.default_rng(1)
    away = (LAYOUT.centres - LAYOUT.centres.mean(axis=0)).T
    along = away / np.hypot(*away)
    noise = along * rng.normal(0.0, 0.1, (4000, 1, len(LAYOUT)))
    noise += 0.03 * rng.normal(size=(4000, 2, len(LAYOUT)))
    slopes = slopes_of(noise)
    changed = [0.01 * along[0] * along[1], *np.sqrt(0.01 * along**2 + 0.03**2)]
    names = "covariance_xy", "standard_error_x", "standard_error_y"
    rows: Any = (np.broadcast_to(values, slopes.x.shape).astype(np.float32) for values in changed)
    slopes = replace(slopes, **dict(zip(names, rows, strict=True)))
    found = fit_wavefront(slopes, LAYOUT, modes=9)
    # The scatter of 4000 frames is known to 1.1 %.
    np.testing.assert_allclose(found.standard_errors[0], found.coefficients.std(axis=0), rtol=0.05)
    seen = slope_discrepancy(slopes, LAYOUT)
    np.testing.assert_allclose(np.sqrt(np.mean(seen.rms_px**2)), seen.expected_px[0], rtol=0.05)


def test_a_tilt_in_nanometres() -> None:
    position = np.zeros((1, 2, len(LAYOUT)))
    position[0, 0] = 0.5  # px: 0.2 arcsec, over 4.2 m
    found = fit_wavefront(slopes_of(position), SCALED)
    edge_to_edge_nm = 0.2 * RAD * 4.2e9
    assert found.unit == "nm"
    assert found.coefficients[0, 0] == pytest.approx(edge_to_edge_nm / 4, rel=1e-6)  # Z2 = 2 x
    assert found.rms()[0] == pytest.approx(edge_to_edge_nm / 4, rel=1e-6)
    assert found.rms(tilt=False)[0] == pytest.approx(0, abs=1e-3)
    sheet = found.sheet(points=101)
    assert sheet[50, 100] - sheet[50, 0] == pytest.approx(edge_to_edge_nm, rel=1e-6)  # late where spots go
    assert np.isnan(sheet[0, 0])
    assert np.nanmax(np.abs(found.sheet(points=101, tilt=False))) == pytest.approx(0, abs=1e-3)
    by_size = fit_wavefront(slopes_of(position), replace(SCALED, diameter_m=None, subaperture_m=0.6))
    np.testing.assert_allclose(by_size.coefficients, found.coefficients)


def test_standard_errors_are_those_of_the_scatter() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(scale=0.1, size=(4000, 2, len(LAYOUT)))
    known = fit_wavefront(slopes_of(noise, error=0.1), SCALED)
    from_residuals = fit_wavefront(slopes_of(noise), SCALED)
    scatter = known.coefficients.std(axis=0)
    assert known.errors_from == "slopes"
    assert from_residuals.errors_from == "residuals"
    # 4000 frames: 1.1 % of error of each, 4 standard deviations.
    np.testing.assert_allclose(known.standard_errors[0], scatter, rtol=0.045)
    of_residuals = np.sqrt((from_residuals.standard_errors**2).mean(axis=0))
    np.testing.assert_allclose(of_residuals, scatter, rtol=0.045)
    np.testing.assert_allclose(known.mean_standard_error, scatter / np.sqrt(4000), rtol=1e-3)
    assert np.all(np.abs(known.mean) < 4.5 * known.mean_standard_error)
    np.testing.assert_allclose(known.rms_of_frames, np.hypot(scatter, known.mean))
    # Of 72 slopes, 27 modes leave 45 degrees of freedom.
    assert np.sqrt(np.mean(known.residual_px**2)) == pytest.approx(0.1 * np.sqrt(45 / 72), rel=0.01)


def test_frames_with_too_few_valid_are_left_out() -> None:
    true = np.ones((3, 14))
    slopes = flagged(slopes_of(slopes_of_modes(LAYOUT, true)), (1, slice(0, 31)))
    found = fit_wavefront(slopes, LAYOUT)
    assert list(found.fitted) == [True, False, True]
    assert found.left_out == "left out 31 slopes of 108: dark"
    assert "Left out 31 slopes of 108: dark." in remarks(found)
    np.testing.assert_allclose(found.mean, found.coefficients[0], rtol=1e-4)


def test_of_one_frame() -> None:
    found = fit_wavefront(slopes_of(np.ones((2, len(LAYOUT))), error=0.1), LAYOUT)
    assert found.coefficients.shape == (1, 27)
    np.testing.assert_allclose(found.mean_standard_error, found.standard_errors[0])


@pytest.mark.parametrize(("n_side", "expected"), [(2, 2), (3, 5), (4, 9), (7, 27), (20, 44)])
def test_number_of_modes_follows_the_sensor(n_side: int, expected: int) -> None:
    layout = Layout.grid((n_side, n_side), pixels=4)
    found = fit_wavefront(slopes_of(np.zeros((1, 2, len(layout)))), layout)
    assert len(found.modes) == expected
    assert found.condition <= 20


def test_too_many_modes_are_refused() -> None:
    slopes = slopes_of(np.zeros((2, 2, len(LAYOUT))))
    with refused("modes = 44", "36 valid"):
        fit_wavefront(slopes, LAYOUT, modes=44)
    with refused("modes"):
        fit_wavefront(slopes, LAYOUT, modes=73)
    for valid in range(3):
        dark = np.broadcast_to(np.arange(len(LAYOUT)) >= valid, (2, len(LAYOUT)))
        with pytest.raises(InputError, match=f"at least 3 valid sub-apertures .*, got {valid} of 36 .*dark"):
            fit_wavefront(flagged(slopes, dark), LAYOUT)
    dark = np.arange(len(LAYOUT)) >= np.array([[2], [3]])  # of two frames
    assert fit_wavefront(flagged(slopes, dark), LAYOUT).fitted.tolist() == [False, True]
    with refused("35 sub-apertures", "36"):
        fit_wavefront(slopes, LAYOUT[1:])
    for diameter_m in (1.5, 5.0):  # of 3 and 10 sub-apertures, where 7 have flux
        with pytest.raises(InputError, match="sub-apertures across, but those with flux"):
            fit_wavefront(slopes, replace(SCALED, diameter_m=diameter_m, subaperture_m=0.5))


def test_corners_of_a_square_array_are_outside_of_the_disk() -> None:
    layout = Layout.grid((7, 7), pixels=8)
    assert pupil_of(layout).radius_subapertures == pytest.approx(3.5)
    inside = inside_pupil(layout, pupil_of(layout))
    assert np.count_nonzero(~inside) == 12  # those at (3, 3) and (3, 2) from the middle
    frames = np.zeros((1, 56, 56))
    slopes = SlopePipeline(layout, Settings("centroid"))(frames + 1.0)
    wild = replace(slopes, x=np.where(inside, slopes.x, 3.0).astype(np.float32))
    np.testing.assert_array_equal(
        fit_wavefront(wild, layout).coefficients, fit_wavefront(slopes, layout).coefficients
    )


@pytest.mark.parametrize("lengths", [(None, 5.5), (0.5, None), (0.5, 5.5)])
def test_the_disk_is_that_of_the_light(lengths: tuple[float | None, float | None]) -> None:
    """A layout from a source that overfills the pupil of a star, which lies beside the middle."""
    side, diameter = lengths
    whole = Layout.grid((15, 15), pixels=8, pixel_scale_arcsec=0.2, subaperture_m=side, diameter_m=diameter)
    lit = np.hypot(*(whole.cells - (8.0, 8.5)).T) < 5.5  # of 15 from 0
    true = np.random.default_rng(6).normal(size=(2, 9))
    positions = np.zeros((2, 2, len(whole)))
    pupil = pupil_of(whole[lit])
    outlines = lit_outlines(whole[lit], pupil)[0] if pupil.cuts else lenslet_outlines(whole[lit])
    gradients = mean_gradients(np.arange(2, 11), (outlines - pupil.centre_px) / pupil.radius_px)
    positions[:, :, lit] = np.einsum("ank,fk->fan", gradients, true)
    slopes = flagged(slopes_of(positions), np.broadcast_to(~lit, (2, len(whole))))
    found, alone = (
        fit_wavefront(slopes, whole, modes=9),
        fit_wavefront(slopes_of(positions[:, :, lit]), whole[lit], modes=9),
    )
    nm_per_px_radius = 0.2 * RAD * 1e9 * 2.75
    for wavefront in (found, alone):
        assert wavefront.pupil.radius_m == pytest.approx(2.75)
        np.testing.assert_allclose(wavefront.coefficients, nm_per_px_radius * true, atol=0.01)
    assert found.pupil.part
    assert "around those with flux" in remarks(found)[0]
    assert side_m(whole.cells, side, diameter, slopes.flags) == pytest.approx(0.5)


def test_subapertures_that_the_pupil_cuts_count_with_their_part_inside() -> None:
    """A pupil of 8 sub-apertures with one on its axis: those at its edge are lit in part."""
    whole = Layout.grid((9, 9), pixels=8, pixel_scale_arcsec=0.5, subaperture_m=0.5, diameter_m=4.0)
    true = {4: 40.0, 5: 60.0, 7: 33.5}  # nm
    offset = (np.arange(64) + 0.5) / 64 - 0.5
    gradients, share = np.zeros((2, len(whole))), np.zeros(len(whole))
    for number, (row, column) in enumerate(whole.cells - 4):
        x, y = np.meshgrid((column + offset) / 4, (row + offset) / 4)
        inside = np.hypot(x, y) <= 1
        share[number] = inside.mean()
        for axis, step in enumerate(((1e-4, 0.0), (0.0, 1e-4))):
            for mode, value in true.items():
                ahead = zernike(mode, x + step[0], y + step[1]) - zernike(mode, x - step[0], y - step[1])
                gradients[axis, number] += value * (ahead[inside].mean() if inside.any() else 0.0) / 2e-4
    lit = share > 0.2
    layout = whole[lit]
    slopes = slopes_of(gradients[:, lit] / (0.5 * 2.0 * 1e9 * RAD))
    found = fit_wavefront(slopes, layout, modes=9)
    assert found.unit == "nm"
    for mode, value in zip(found.modes.tolist(), found.mean.tolist(), strict=True):
        # Means over 64 x 64 points, and a disk of 256 corners.
        assert value == pytest.approx(true.get(mode, 0.0), abs=0.1)
    outlines, part = lit_outlines(layout, pupil_of(layout))
    np.testing.assert_allclose(part, share[lit], atol=2e-3)
    assert outlines.shape[::2] == (len(layout), 2)


def test_slopes_count_by_their_standard_errors() -> None:
    """A few noisy sub-apertures do not spoil a mode: errors are those of weighted least squares."""
    rng = np.random.default_rng(4)
    error = np.where(np.arange(len(LAYOUT)) % 3 == 0, 1.0, 0.02)
    noise = rng.normal(size=(400, 2, len(LAYOUT))) * error
    slopes = slopes_of(noise)
    errors = np.broadcast_to(error, slopes.x.shape).astype(np.float32)
    found = fit_wavefront(replace(slopes, standard_error_x=errors, standard_error_y=errors), LAYOUT, modes=5)
    np.testing.assert_allclose(found.coefficients.std(axis=0), found.standard_errors[0], rtol=0.15)
    plain = fit_wavefront(slopes, LAYOUT, modes=5)
    assert (found.coefficients.std(axis=0) < 0.2 * plain.coefficients.std(axis=0)).all()


@pytest.mark.parametrize("frames", mostly_slow(1, [1, 6]))
def test_errors_count_what_no_mode_explains(frames: int) -> None:
    """Spots that are off by 0.3 px in every frame, with stated errors of 0.01 px: errors are those of 0.3 px.

    The scatter of 9 modes in 30 draws is known to 4 %.
    """
    rng, deviations = np.random.default_rng(5), []
    for _ in range(30):
        fixed = rng.normal(0.0, 0.3, (1, 2, len(LAYOUT)))
        found = fit_wavefront(
            slopes_of(fixed + rng.normal(0.0, 0.01, (frames, 2, len(LAYOUT))), 0.01), LAYOUT, modes=9
        )
        deviations.append(found.mean / found.mean_standard_error)
    assert np.std(deviations) == pytest.approx(1.0, abs=0.15)


def test_spots_that_do_not_converge_carry_few_modes() -> None:
    slopes = slopes_of(np.zeros((1, 2, len(LAYOUT))))
    lost = np.where(np.arange(len(LAYOUT)) < 8, 0, int(SubapertureFlag.NOT_CONVERGED)).astype(np.uint8)
    assert len(fit_wavefront(slopes, LAYOUT).modes) > 20
    assert len(fit_wavefront(replace(slopes, flags=lost[None]), LAYOUT).modes) == 5
