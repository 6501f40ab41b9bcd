from __future__ import annotations

import math

import numpy as np
import pytest
from tests.ao_loop.loop_cases import faint, plain

from faintspot.ao_loop import LoopRecord, simulate_loop
from faintspot.ao_loop.pseudo_open_loop import r0_of_record
from faintspot.base.errors import InputError
from faintspot.turbulence.seeing import KOLMOGOROV, Seeing, estimate_r0, mean_r0, slope_variance

SIDE = 0.6
OUTER_SCALE = 25.0
SCALE = 1e-6  # rad for a pixel


def test_slope_variance_agrees_with_the_structure_function() -> None:
    # The mean gradient is the difference of the phase's means over two opposite edges; Kolmogorov's
    # structure function is 6.88 (r / r0)^(5/3). Both sums are good to a percent.
    along = np.linspace(-SIDE / 2, SIDE / 2, 401)
    apart = along[:, None] - along
    cross, same = (6.88 * np.mean((apart**2 + distance**2) ** (5 / 6)) for distance in (SIDE, 0.0))
    expected = (cross - same) / SIDE**2 * (500e-9 / (2 * math.pi)) ** 2
    assert slope_variance(SIDE, KOLMOGOROV) == pytest.approx(expected, rel=0.01)


def test_kolmogorov_theory_overestimates_r0_by_forty_percent() -> None:
    ratio = slope_variance(SIDE, OUTER_SCALE) / slope_variance(SIDE, KOLMOGOROV)
    assert ratio ** (-3 / 5) == pytest.approx(1.4, abs=0.05)


def test_without_tip_and_tilt_the_outer_scale_matters_little() -> None:
    positions = SIDE * np.stack(np.meshgrid(np.arange(7), np.arange(7)), -1).reshape(-1, 2)
    near, far = (slope_variance(SIDE, scale, positions=positions) for scale in (OUTER_SCALE, KOLMOGOROV))
    assert (near / far) ** (-3 / 5) < 1.08
    assert near < slope_variance(SIDE, OUTER_SCALE)


def test_both_axes_have_the_same_variance() -> None:
    assert slope_variance(SIDE, OUTER_SCALE, along=(0, 1)) == pytest.approx(slope_variance(SIDE, OUTER_SCALE))


def synthetic(noise_px: float, r0_m: float = 0.15, frames: int = 6000) -> Seeing:
    """Slopes of a single sub-aperture and of others like it, smooth in time, with white noise."""
    rng = np.random.default_rng(5)
    n = 9
    steps = rng.normal(size=(frames + 60, 2 * n))
    kernel = np.exp(-0.5 * (np.arange(-30, 31) / 8.0) ** 2)
    smooth = np.apply_along_axis(np.convolve, 0, steps, kernel / np.linalg.norm(kernel), mode="valid")
    std = math.sqrt(slope_variance(SIDE, OUTER_SCALE) * r0_m ** (-5 / 3)) / SCALE
    slopes = std * smooth + rng.normal(0, noise_px, smooth.shape)
    cells = np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2)
    return estimate_r0(
        slopes,
        cells=cells,
        subaperture_m=SIDE,
        pixel_scale_rad=SCALE,
        outer_scale_m=OUTER_SCALE,
        remove_tip_tilt=False,
    )


@pytest.mark.parametrize("noise_px", [0.0, 0.3, 2.0])
def test_noise_does_not_change_r0(noise_px: float) -> None:
    # 6000 frames of about 20 each that go together: the variance is good to 3 %, r0 to 2 %.
    found = synthetic(noise_px)
    assert found.r0_m == pytest.approx(0.15, rel=0.05)
    assert found.noise_std_px == pytest.approx(noise_px, abs=0.03)


def test_slopes_of_noise_alone_tell_no_r0() -> None:
    alternating = np.tile([[1.0], [-1.0]], (50, 18))
    cells = np.stack(np.meshgrid(np.arange(3), np.arange(3)), -1).reshape(-1, 2)
    found = estimate_r0(
        alternating,
        cells=cells,
        subaperture_m=1,
        pixel_scale_rad=SCALE,
        outer_scale_m=25,
        remove_tip_tilt=False,
    )
    assert math.isnan(found.r0_m)


@pytest.fixture(scope="module")
def record() -> LoopRecord:
    pytest.importorskip("hcipy")
    return simulate_loop(faint().replace("run", frames=1600), [plain()], realisation=1)


def test_r0_of_a_loop_is_the_simulated_one_within_ten_percent(record: LoopRecord) -> None:
    # Six seconds hold some tens of independent wavefronts: 4 % of r0, measured over realisations.
    found = r0_of_record(record, record.scored)
    truth = mean_r0(record.r0_m)
    assert found.r0_m == pytest.approx(truth, rel=0.10)
    assert (found.r0_x_m, found.r0_y_m) == pytest.approx((truth, truth), rel=0.15)


def test_kolmogorov_theory_on_whole_slopes_of_a_loop_is_far_off(record: LoopRecord) -> None:
    found = r0_of_record(record, record.scored, remove_tip_tilt=False)
    assert found.r0_kolmogorov_m > 1.25 * mean_r0(record.r0_m)


def test_frames_apart_are_not_taken_for_neighbours(record: LoopRecord) -> None:
    gaps = record.scored & (np.arange(record.frames) % 50 < 40)
    assert r0_of_record(record, gaps).r0_m == pytest.approx(
        r0_of_record(record, record.scored).r0_m, rel=0.05
    )


def test_mean_r0_is_that_of_the_mean_strength() -> None:
    assert mean_r0([0.1, 0.1]) == pytest.approx(0.1)
    assert 0.1 < mean_r0([0.1, 0.2]) < 0.15


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"slopes_px": np.zeros((10, 8))}, "at least 20 frames"),
        ({"cells": [[0, 0]]}, "slopes_px: expected shape"),
        ({"cells": [0, 1]}, "cells: expected row and column"),
        ({"segment": [1, 2]}, "segment: expected"),
        ({"static_px": [1.0]}, "static_px: expected 8"),
        ({"outer_scale_m": 0.0}, "outer_scale_m = 0"),
        ({"subaperture_m": -1.0}, "subaperture_m = -1"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changes: dict[str, object], words: str) -> None:
    values: dict[str, object] = {
        "slopes_px": np.random.default_rng(0).normal(size=(30, 8)),
        "cells": [[0, 0], [0, 1], [1, 0], [1, 1]],
        "subaperture_m": 0.5,
        "pixel_scale_rad": 1e-6,
        "outer_scale_m": 25.0,
    }
    with pytest.raises(InputError, match=words) as error:
        estimate_r0(**{**values, **changes})  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
