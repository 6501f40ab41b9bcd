"""Do backgrounds of a frame or of its lenslets move the slopes?

Spots in the middles of 116 sub-apertures of a round pupil, under sky that is even, seen through lit lenslets
only (a field stop at the edge of each), haze (a Gaussian as wide as the pupil), glow (from a corner of the
camera) or straylight (a ramp across the frame). Layout, settings and dark follow from the frames themselves.
The error of the mean slopes, rms of an axis over the valid sub-apertures at the edge of the pupil, is below
0.1 px or twice its noise, whichever is larger; layouts may be refused or doubtful.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.io.frames import open_frames
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.recorded.first_layout import first_layout
from faintspot.slopes.sensor.region import neighbours_of

ACROSS, PIXELS, READ_NOISE_E, OFFSET_ADU, FRAMES, SEED = 14, 12, 2.0, 100.0, 40, 1
KINDS = ("even", "edge", "edge, partly lit", "haze", "glow", "straylight")
FWHM_PX, FLUX_E, SKY_E = (3.0, 5.5, 7.0), (20.0, 100.0, 600.0, 6000.0), (10.0, 40.0, 100.0)
LIMIT_PX = 0.1
Floats = NDArray[np.float64]


def scene(kind: str, fwhm_px: float) -> tuple[Floats, Floats]:
    """Return the images of spots with a flux of 1, and of a sky of 1 a pixel."""
    away = np.arange(ACROSS) - 0.5 * (ACROSS - 1)
    radius = np.hypot(away, away[:, None])
    lit = ((radius <= 6.3) & (radius >= 1.2)).astype(np.float64)
    if kind == "edge, partly lit":
        lit[(radius > 5.6) & (lit > 0)] = 0.5
    edges, middles = np.arange(ACROSS * PIXELS + 1), PIXELS * (np.arange(ACROSS) + 0.5)
    profiles = np.diff(ndtr((edges - middles[:, None]) / (fwhm_px / 2.3548)), axis=1)
    y, x = np.indices((ACROSS * PIXELS,) * 2) / (ACROSS * PIXELS - 1)
    skies = {
        "even": np.ones(x.shape),
        "haze": np.exp(-4 * np.log(2) * ((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.8**2),
        "glow": np.exp(-np.hypot(x, y) / 0.3),
        "straylight": x,
    }
    sky = skies[kind] if kind in skies else np.kron(lit, np.ones((PIXELS, PIXELS)))
    return np.asarray(profiles.T @ lit @ profiles), sky


def frames_of(kind: str, fwhm_px: float, flux_e: float, sky_e: float) -> Floats:
    """Return frames (n, h, w), ADU of one electron."""
    rng, (spots, sky) = np.random.default_rng(SEED), scene(kind, fwhm_px)
    shape = (FRAMES, *spots.shape)
    counts = rng.poisson(flux_e * spots + sky_e * sky, shape) + rng.normal(OFFSET_ADU, READ_NOISE_E, shape)
    return np.asarray(counts.round())


def measured(frames: Floats) -> dict[str, float]:
    """Return the mean error at the edge of the pupil, its noise, and the valid part of the slopes."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "frames.npy")
        np.save(path, frames.astype(np.uint16))
        with open_frames([path]) as source:
            first = first_layout(source, Calibration(), {}, optics={})
    layout = first.layout
    slopes = SlopePipeline(layout, first.seen.settings, first.calibration)(frames)
    at_edge = (neighbours_of(layout.cells, layout.geometry) == len(layout)).any(axis=1)
    used = at_edge & (slopes.valid.sum(axis=0) > 1)
    moved = np.stack([np.where(slopes.valid, part, np.nan) for part in (slopes.x, slopes.y)])[..., used]
    error = np.nanmean(moved, axis=1)
    noise = np.nanstd(moved, axis=1, ddof=1) / np.sqrt(slopes.valid[:, used].sum(axis=0))
    return {
        "sub-apertures": float(len(layout)),
        "doubtful": float(bool(layout.doubts)),
        "valid": float(slopes.valid.mean()),
        "error (px)": float(np.sqrt(np.nanmean(error**2))),
        "noise (px)": float(np.sqrt(np.nanmean(noise**2))),
        "largest (px)": float(np.nanmax(np.abs(error), initial=0.0)),
    }


def cases() -> Iterator[tuple[str, float, float, float]]:
    """Yield kind, width, flux and sky."""
    yield from product(KINDS, FWHM_PX, FLUX_E, SKY_E)


def run() -> list[Table]:
    """Measure all backgrounds."""
    rows = []
    for kind, fwhm_px, flux_e, sky_e in cases():
        name = f"{kind}, {fwhm_px:g} px, {flux_e:g} e- under {sky_e:g} e-"
        try:
            values = measured(frames_of(kind, fwhm_px, flux_e, sky_e))
        except InputError:
            rows.append(Row(name, {}, "refused", True))
            continue
        limit = max(LIMIT_PX, 2 * values["noise (px)"])
        met = bool(values["doubtful"]) or values["error (px)"] < limit
        rows.append(Row(name, values, f"error below {limit:.2g} px", met))
    return [Table("backgrounds", "Errors at the edge of the pupil under backgrounds", rows)]
