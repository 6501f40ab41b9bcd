"""Orders of sub-apertures that do not fit the interaction matrix."""

from dataclasses import replace

import numpy as np
import pytest
from tests.loop.control.frozen_flow import frozen_slopes
from tests.loop.telemetry.loop_cases import AIR, CELLS, CORNERS, NOISE_PX, RATE_HZ

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.recording import Recording, prepared
from faintspot.loop.slope_covariance import order_remark, smoothness

APART = CORNERS - CELLS[:, None]
INSIDE = ((APART == 0) | (APART == 1)).all(axis=2)
ZONAL = np.vstack([INSIDE * (APART[..., axis] - 0.5) for axis in (1, 0)])
"""Slopes of bilinear wavefronts between the corners of 5 x 5 sub-apertures."""


def modal(modes: int) -> np.ndarray:
    """Return the matrix of as many modes, smooth ones first, in another unit."""
    x, y = (CORNERS - 2.5).T
    shapes = np.array([x**i * y**j for i in range(4) for j in range(4 - i) if i + j][:modes]).T
    return np.asarray(1e-6 * ZONAL @ shapes)


@pytest.mark.parametrize("matrix", [ZONAL, -1e5 * ZONAL, modal(9), modal(2)])
def test_right_orders(matrix: np.ndarray) -> None:
    assert order_remark(matrix, CELLS) == ""


@pytest.mark.parametrize(
    ("rows", "cells", "message"),
    [
        (np.arange(50), CELLS[:, ::-1], "by columns, or with y before x"),
        (np.roll(np.arange(50), 25), CELLS, "by columns, or with y before x"),
        (np.arange(50).reshape(2, 25).T.ravel(), CELLS, "with x and y of each sub-aperture in turn"),
        (np.arange(50), CELLS * [-1, 1], "with y, or rows, counted upwards"),
    ],
)
def test_known_orders_are_named(rows: np.ndarray, cells: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        order_remark(ZONAL[rows], cells)


def test_shuffled_cells() -> None:
    shuffled = np.random.default_rng(1).permutation(CELLS)
    with pytest.raises(InputError, match="check that row and column of each"):
        order_remark(ZONAL, shuffled)


def test_a_few_exchanged_cells_are_remarked() -> None:
    cells = CELLS.copy()
    cells[[6, 7, 17, 18]] = cells[[17, 18, 6, 7]]
    assert "check that row and column of each" in order_remark(ZONAL, cells)


@pytest.fixture(scope="module")
def turbulence() -> Recording:
    slopes = frozen_slopes(AIR, 600, RATE_HZ, np.random.default_rng(1))
    slopes += NOISE_PX * np.random.default_rng(2).standard_normal(slopes.shape)
    return Recording(slopes, None, None, CELLS, RATE_HZ, subaperture_m=0.6, is_closed=False)


def test_open_loops_are_judged_by_the_turbulence(turbulence: Recording) -> None:
    assert prepared(turbulence).recording.remarks == ()
    exchanged = replace(turbulence, slopes=np.roll(turbulence.slopes, 25, axis=1))
    with pytest.raises(InputError, match="the turbulence fits slopes by columns, or with y before x"):
        prepared(exchanged)
    shuffled = np.random.default_rng(1).permutation(CELLS)
    with pytest.raises(InputError, match="the turbulence makes no smooth wavefronts"):
        prepared(replace(turbulence, cells=shuffled))
    noise = np.random.default_rng(3).standard_normal(turbulence.slopes.shape)
    assert prepared(replace(turbulence, slopes=noise, cells=shuffled)).recording.remarks == ()


def test_large_sensors_are_judged_by_a_part() -> None:
    """Of 400 sub-apertures, those in the middle."""
    cells, corners = (np.argwhere(np.ones((side, side))) for side in (20, 21))
    apart = corners - cells[:, None]
    inside = ((apart == 0) | (apart == 1)).all(axis=2)
    matrix = np.vstack([inside * (apart[..., axis] - 0.5) for axis in (1, 0)])
    assert smoothness(matrix, cells) > 0.9
    assert abs(smoothness(matrix, cells[:, ::-1])) < 0.4
