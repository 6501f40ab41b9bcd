"""Which slopes are valid: of wrong ones almost none, of right ones almost all.

Random sensors in a wavefront of low orders. Some spots are lost, some lie beyond their windows, and
reflections lie anywhere. A slope is wrong if it is off by more than 5 of its stated standard errors and more
than 0.3 px: at low flux, errors of 0.3 px are noise that the errors state. A lost spot's position is where it
would be. Left out: frames in which all spots are beyond their windows, which no neighbour contradicts.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table

SENSORS, FRAMES, READ_NOISE_E = 12, 20, 3.0
FLUXES_E = 60.0, 200.0, 1000.0, 10000.0
LOST, DISPLACED, REFLECTIONS = 0.06, 0.03, 0.02
"""Share of the lenslets without a spot, with one beyond their window; reflections over lenslets."""
WRONG_ERRORS, WRONG_PX = 5.0, 0.3
MOST_WRONG_VALID, MOST_RIGHT_INVALID = 0.01, 0.005


@dataclass(frozen=True)
class Recording:
    """Frames of a sensor with their truth, and what is stated of its spots."""

    layout: fs.Layout
    frames: NDArray[np.float32]
    truth: NDArray[np.float64]
    whole: NDArray[np.bool_]
    """Which lenslets have their spot in their window, (n,): others have no right slope."""
    fwhm_px: float
    range_px: float


def recording(rng: np.random.Generator, flux_e: float) -> Recording:
    """Return frames of a random sensor."""
    side, pixels, fwhm = int(rng.integers(7, 13)), int(rng.integers(14, 23)), float(rng.uniform(2.0, 3.5))
    place: dict[str, Any] = {"origin": (pixels, pixels), "frame_shape": (pixels * (side + 2),) * 2}
    layout = fs.Layout.grid((side, side), pixels=pixels, outer_radius=side / 2, **place)
    n, reach = len(layout), pixels / 2 - 1.5 * fwhm
    away = (layout.centres - layout.centres.mean(axis=0)) / (0.5 * side * pixels)
    orders = rng.normal(0.0, 0.12 * reach, (FRAMES, 3, 2)) * 0.5 + rng.normal(0.0, 0.12 * reach, (3, 2))
    truth = orders[:, 0, None] + away * orders[:, 1, None] + away[:, ::-1] * orders[:, 2, None]
    truth += rng.normal(0.0, 0.02 * reach, truth.shape)
    kinds = rng.random(n)
    flux = flux_e * np.where(kinds < LOST, 0.0, rng.uniform(0.6, 1.0, n))
    moved = (kinds > 1 - DISPLACED)[:, None] * _anywhere(rng, n, 0.55 * pixels, 0.9 * pixels)
    ghosts = rng.permutation(n)[: max(1, round(REFLECTIONS * n))]
    spots = np.concatenate(
        [truth + moved, truth[:, ghosts] + _anywhere(rng, len(ghosts), 0.0, reach)], axis=1
    )
    corners = np.concatenate([layout.corners, layout.corners[ghosts]])
    fluxes = np.concatenate([flux, flux_e * rng.uniform(0.3, 3.0, len(ghosts))])
    light = np.stack([_frame(layout.frame_shape, corners, pixels, at, fluxes, fwhm) for at in spots])
    frames = rng.poisson(light) + READ_NOISE_E * rng.standard_normal(light.shape)
    whole = (flux > 0) & ~moved.any(axis=1)
    return Recording(layout, frames.astype(np.float32), truth, whole, fwhm, reach)


def _anywhere(rng: np.random.Generator, n: int, least: float, most: float) -> NDArray[np.float64]:
    """Return displacements in any direction."""
    angle, distance = rng.uniform(0, 2 * np.pi, n), rng.uniform(least, most, n)
    moved: NDArray[np.float64] = distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return moved


def _frame(
    shape: tuple[int, int],
    corners: NDArray[np.int64],
    pixels: int,
    positions: NDArray[np.float64],
    flux_e: NDArray[np.float64],
    fwhm: float,
) -> NDArray[np.float64]:
    """Return a frame of Gaussian spots, px from their windows' middles, that reach into other windows."""
    light, sigma = np.zeros(shape), fwhm / 2.355
    offset = np.arange(-pixels, 2 * pixels)
    for (row, column), (x, y), flux in zip(corners, positions, flux_e, strict=True):
        along, across = (np.exp(-0.5 * ((offset - (pixels - 1) / 2 - at) / sigma) ** 2) for at in (x, y))
        spot = flux / (2 * np.pi * sigma**2) * np.outer(across, along)
        light[row - pixels : row + 2 * pixels, column - pixels : column + 2 * pixels] += spot
    return light


def methods(record: Recording, flux_e: float) -> dict[str, fs.Settings]:
    """Return the settings of several estimators for a recording."""
    common = {"search_range_px": record.range_px, "spot_fwhm_px": record.fwhm_px}
    kept = round(6 * (record.fwhm_px / 2) ** 2 * 2)
    return {
        "weighted": fs.Settings("weighted", weight_fwhm_px=1.5 * record.fwhm_px, **common),
        "brightest": fs.Settings("brightest", keep_brightest=kept, **common),
        "tv": fs.Settings("tv", noise_std=READ_NOISE_E, keep_brightest=kept, **common),
        "ml": fs.Settings("ml", **common),
    }


def shares(flux_e: float, seed: int) -> dict[str, NDArray[np.float64]]:
    """Return by method: right and wrong slopes, valid of these without and with checks, invalid of those."""
    rng, found = np.random.default_rng(seed), dict[str, NDArray[np.float64]]()
    camera = fs.Calibration(dark=0.0, read_noise_e=READ_NOISE_E)
    for _ in range(SENSORS):
        record = recording(rng, flux_e)
        psf = fs.PSF.analytic("gaussian", size=record.fwhm_px / 2)
        for name, settings in methods(record, flux_e).items():
            pipeline = fs.SlopePipeline(record.layout, settings, camera, psf=psf)
            checked = pipeline.with_dark(record.frames.mean(axis=0))
            pipeline.light_test = pipeline.light_test._replace(box=0)
            plain, slopes = pipeline(record.frames), checked(record.frames)
            off = np.abs(np.stack([plain.x, plain.y], axis=-1) - record.truth).max(axis=-1)
            stated = np.maximum(plain.standard_error_x, plain.standard_error_y)
            stated = np.where(np.isfinite(stated), stated, 0.0)
            wrong = off > np.maximum(WRONG_ERRORS * stated, WRONG_PX)
            right = ~wrong & record.whole
            counts = [
                right.sum(),
                wrong.sum(),
                *(np.count_nonzero(wrong & valid) for valid in (plain.measured, slopes.valid)),
                *(np.count_nonzero(right & ~valid) for valid in (plain.measured, slopes.valid)),
            ]
            found[name] = found.get(name, np.zeros(6)) + np.array(counts, float)
    return found


def run() -> list[Table]:
    """Count wrong slopes that are valid, and right ones that are not."""
    rows = []
    for flux_e in FLUXES_E:
        for name, (right, wrong, before, after, lost_before, lost) in shares(flux_e, 1).items():
            values = {
                "wrong (%)": 100 * wrong / (right + wrong),
                "of wrong valid, unchecked (%)": 100 * before / max(wrong, 1),
                "of wrong valid (%)": 100 * after / max(wrong, 1),
                "of right invalid, unchecked (%)": 100 * lost_before / right,
                "of right invalid (%)": 100 * lost / right,
            }
            met = after <= MOST_WRONG_VALID * wrong and lost <= MOST_RIGHT_INVALID * right
            rows.append(Row(f"{flux_e:g} e-, {name}", values, "wrong 1 %, right 0.5 %", bool(met)))
    note = (
        f"{SENSORS} random sensors, {FRAMES} frames each, read noise {READ_NOISE_E:g} e-; wrong: off by "
        f"more than {WRONG_ERRORS:g} stated errors and {WRONG_PX:g} px"
    )
    return [Table("validity", "Wrong slopes that are valid, right ones that are not", rows, [note])]
