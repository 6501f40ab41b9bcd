"""The arms of a study that keep the brightest pixels, or what is above a threshold."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintspot.estimate.centroid import centre_of_gravity
from faintspot.estimate.total_variation import tv_denoise
from faintspot.kernels import scoring
from faintspot.settings import Settings
from faintspot.study.sweep import Cell

FLUX_FLOOR: float = Settings.flux_floor
"""No light: the sum that is left is not above this fraction of the image's largest pixel."""

Images = NDArray[np.float32]
Floats = NDArray[np.float64]


def error_table(
    arm: str,
    candidate: float,
    cell: Cell,
    images: Images,
    truth: Floats,
    search_range_px: float = math.inf,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return (|dx| + |dy|) / 2 of every image for every number k of kept pixels.

    Parameters
    ----------
    arm : str
        One of `faintspot.study.specification.BRIGHTEST_ARMS`.
    candidate : float
        "tv": strength, as a fraction of `cell.pixel_noise_e`; "gaussian": standard deviation, px, of the
        Gaussian, the image being continued by zeros; "thresholded": threshold in units of
        `cell.pixel_noise_e`; NaN for the others.
    cell : Cell
    images : (n, side, side) array, float32
    truth : (n, 2) array, px
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.

    Returns
    -------
    errors : (n, K) array, float32
        For k = 1 to K = side^2 - 1, px; K = 1 for "thresholded", which has no k.
    valid : (n, K) array, bool
        Whether there was light. Where not, the position counts as (0, 0).
    """
    if arm == "thresholded":
        positions, valid = _above_threshold(images, candidate * cell.pixel_noise_e, search_range_px)
        return np.abs(positions - truth).mean(axis=1).astype(np.float32)[:, None], valid
    prepared, rule = _prepared(arm, candidate, cell, images)
    errors = np.empty((len(images), prepared.shape[1] - 1), np.float32)
    valid = np.empty(errors.shape, np.bool_)
    span = (0, len(images))
    scoring.errors_of_every_k(
        prepared, cell.pixels, rule, FLUX_FLOOR, search_range_px, truth, *span, errors, valid
    )
    return errors, valid


def position_table(
    arm: str, candidate: float, cell: Cell, images: Images, search_range_px: float = math.inf
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the positions (n, K, 2), px, whose errors `error_table` returns, and their validity (n, K)."""
    if arm == "thresholded":
        above, valid = _above_threshold(images, candidate * cell.pixel_noise_e, search_range_px)
        return above[:, None].astype(np.float64), valid
    prepared, rule = _prepared(arm, candidate, cell, images)
    positions = np.empty((len(images), prepared.shape[1] - 1, 2))
    valid = np.empty(positions.shape[:2], np.bool_)
    span = (0, len(images))
    scoring.positions_of_every_k(
        prepared, cell.pixels, rule, FLUX_FLOOR, search_range_px, *span, positions, valid
    )
    return positions, valid


def _prepared(arm: str, candidate: float, cell: Cell, images: Images) -> tuple[Images, int]:
    """Return the images (n, pixels) as the brightest pixels are sought in them, and the rule."""
    prepared = images
    if arm == "tv":
        prepared = tv_denoise(images, candidate * cell.pixel_noise_e)
    elif arm == "gaussian":
        prepared = gaussian_filter(images, candidate, mode="constant", axes=(-2, -1))
    elif arm == "median":
        prepared = median_of_nine(images)
    rule = scoring.THRESHOLD if arm == "threshold" else scoring.SUBTRACT_NEXT
    return np.ascontiguousarray(prepared).reshape(len(images), -1), rule


def median_of_nine(images: Images) -> Images:
    """Return the median of each pixel and its eight neighbours; pixels at the edge continue outwards.

    The median of nine numbers in three sorted columns is the median of the largest of the small ones, the
    median of the middle ones and the smallest of the large ones.
    """
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), mode="edge")
    low, middle, high = _sorted_three(padded[:, :-2], padded[:, 1:-1], padded[:, 2:])
    small = np.maximum(np.maximum(low[..., :-2], low[..., 1:-1]), low[..., 2:])
    centre = _sorted_three(middle[..., :-2], middle[..., 1:-1], middle[..., 2:])[1]
    large = np.minimum(np.minimum(high[..., :-2], high[..., 1:-1]), high[..., 2:])
    return _sorted_three(small, centre, large)[1]


def _sorted_three(a: Images, b: Images, c: Images) -> tuple[Images, Images, Images]:
    """Return the smallest, the middle and the largest of three images, pixel by pixel."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    return np.minimum(low, c), np.maximum(low, np.minimum(high, c)), np.maximum(high, c)


def _above_threshold(
    images: Images, threshold_e: float, search_range_px: float
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Centre of gravity (n, 2) of what is above a threshold, the threshold taken off, and validity (n, 1)."""
    left = np.maximum(images - np.float32(threshold_e), np.float32(0.0))
    largest = np.abs(images).max(axis=(1, 2))
    valid = left.sum(axis=(1, 2)) > FLUX_FLOOR * largest
    positions = np.where(valid[:, None], centre_of_gravity(left), 0.0)
    return np.clip(positions, -search_range_px, search_range_px), valid[:, None]
