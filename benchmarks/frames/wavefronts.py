"""Wavefronts from the slopes of HCIPy's sensor, by HCIPy's matrices and by faintspot.

HCIPy propagates light through 21 x 21 lenslets, measures spots, and makes interaction matrices by small
pokes of 44 Zernike modes, which its `inverse_tikhonov` inverts. faintspot gets the same
slopes, and the angle of a pixel from a tilt. Wavefronts are compared at the centres of the lit lenslets.
"""

from typing import Any

import hcipy
import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table

Floats = NDArray[np.float64]

ACROSS, PIXELS, DIAMETER_M, WAVELENGTH_M, F_NUMBER = 21, 12, 4.0, 0.65e-6, 50.0
MODES, POKE_M, RMS_M, TILT_RAD, SEEDS = 44, 2e-9, 40e-9, 2e-8, (1, 2, 3)
LIMIT = 1.0  # per cent
_ARCSEC = np.pi / 180 / 3600
_PITCH_M = DIAMETER_M / ACROSS


class Sensor:
    """HCIPy's sensor behind an annular pupil, noiseless; `lit_from` is the least part of a lenslet lit."""

    def __init__(self, lit_from: float = 0.97) -> None:
        self.grid = hcipy.make_pupil_grid(ACROSS * PIXELS, DIAMETER_M)
        aperture = hcipy.make_obstructed_circular_aperture(DIAMETER_M, 0.25)
        self._pupil = hcipy.evaluate_supersampled(aperture, self.grid, 4)
        self._small = self.grid.scaled(1e-3)
        self._optics = hcipy.SquareShackHartmannWavefrontSensorOptics(
            self._small, F_NUMBER, ACROSS, 1e-3 * DIAMETER_M
        )
        index, lenslets = self._optics.mla_index, self._optics.mla_grid
        flux = np.bincount(index, self._image(0 * self.grid.x), lenslets.size)
        lit = flux > lit_from * flux.max()
        self._estimator = hcipy.ShackHartmannWavefrontSensorEstimator(lenslets, index, lit)
        self._flat = self._measured(0 * self.grid.x)
        tilt = self.slopes(TILT_RAD * self.grid.x)[: np.count_nonzero(lit)]
        self._pixel = np.median(tilt)
        """What HCIPy measures for a pixel of the layout."""
        places = np.stack([np.asarray(axis)[lit] for axis in (lenslets.y, lenslets.x)], axis=1)
        self.cells = np.rint(1e3 * places / _PITCH_M).astype(np.int64) + ACROSS // 2
        self.layout = fs.Layout(
            (ACROSS * PIXELS,) * 2,
            (PIXELS,) * 2,
            PIXELS * self.cells,
            cells=self.cells,
            pitch_px=float(PIXELS),
            pixel_scale_arcsec=TILT_RAD / _ARCSEC,
            subaperture_m=_PITCH_M,
            diameter_m=DIAMETER_M,
        )

    def _image(self, path_m: Any) -> Any:
        field = hcipy.Field(self._pupil * np.exp(2j * np.pi / WAVELENGTH_M * path_m), self.grid)
        wavefront = hcipy.Wavefront(field, WAVELENGTH_M)
        wavefront.total_power = 1.0
        return self._optics(hcipy.Magnifier(1e-3)(wavefront)).power

    def _measured(self, path_m: Any) -> Floats:
        return np.asarray(self._estimator.estimate([self._image(path_m)])).ravel()

    def slopes(self, path_m: Any) -> Floats:
        """Return HCIPy's slopes of a path difference, relative to those of a flat wavefront."""
        return self._measured(path_m) - self._flat

    def ours(self, slopes: Floats) -> fs.Slopes:
        """Return HCIPy's slopes as those of faintspot."""
        x, y = (slopes / self._pixel).reshape(2, -1).astype(np.float32)
        zero, unknown = np.zeros(x.shape, np.int32), np.full(x.shape, np.inf, np.float32)
        return fs.Slopes(
            x, y, np.ones_like(x), zero.astype(np.uint8), zero, zero, unknown, unknown, np.zeros_like(x)
        )

    def inverse(self, modes: Floats, rcond: float) -> Floats:
        """Return HCIPy's inverse of the slopes of modes (points, k)."""
        columns = [self.slopes(POKE_M * mode) - self.slopes(-POKE_M * mode) for mode in modes.T]
        return np.asarray(hcipy.inverse_tikhonov(np.array(columns).T / (2 * POKE_M), rcond=rcond))

    def at_centres(self, path_m: Floats) -> Floats:
        """Return a map's values at the centres of the lenslets: means of the four points around them."""
        frame = np.reshape(path_m, (ACROSS * PIXELS,) * 2)
        rows, columns = (PIXELS * self.cells + PIXELS // 2).T
        return np.asarray(sum(frame[rows - down, columns - right] for down in (0, 1) for right in (0, 1)) / 4)


def paths(grid: Any) -> dict[str, list[Floats]]:
    """Return path differences of 40 nm rms by name, one for each seed."""
    found = {}
    for highest in (10, 21):
        modes = np.array(hcipy.make_zernike_basis(highest - 1, DIAMETER_M, grid, 2))
        found[f"Z2 to Z{highest}"] = [
            np.random.default_rng(seed).normal(size=len(modes)) @ modes for seed in SEEDS
        ]
    strength = hcipy.Cn_squared_from_fried_parameter(0.2, 500e-9)
    layers = [hcipy.InfiniteAtmosphericLayer(grid, strength, 25.0, 10.0, seed=seed) for seed in SEEDS]
    found["turbulence"] = [np.asarray(layer.phase_for(WAVELENGTH_M)) for layer in layers]
    return {name: [path * RMS_M / path.std() for path in some] for name, some in found.items()}


def compared(sensor: Sensor) -> dict[str, dict[str, float]]:
    """Return rms differences relative to the true wavefront, by wavefront and pair, of all seeds."""
    zernike = np.array(hcipy.make_zernike_basis(MODES, DIAMETER_M, sensor.grid, 2)).T
    inverse = sensor.inverse(zernike, 1e-3)
    found = {}
    for name, some in paths(sensor.grid).items():
        squares: dict[str, list[float]] = {}
        for path in some:
            slopes, truth = sensor.slopes(path), sensor.at_centres(path)
            coefficients = fs.fit_wavefront(sensor.ours(slopes), sensor.layout, modes=MODES).mean
            ours = sensor.at_centres(zernike @ coefficients) * 1e-9
            theirs = sensor.at_centres(zernike @ (inverse @ slopes))
            pairs = {"ours - HCIPy's": (ours, theirs), "ours - truth": (ours, truth)}
            pairs["HCIPy's - truth"] = theirs, truth
            for pair, (one, other) in pairs.items():
                squares.setdefault(pair, []).append((one - other).var() / truth.var())
        found[name] = {pair: float(np.sqrt(np.mean(values))) for pair, values in squares.items()}
    return found


def run() -> Table:
    """Compare wavefronts of both libraries."""
    rows = []
    for lenslets, lit_from in (("whole lenslets", 0.97), ("half lit ones, too", 0.5)):
        for name, differences in compared(Sensor(lit_from)).items():
            percent = {pair: 100 * value for pair, value in differences.items()}
            met = percent["ours - HCIPy's"] <= LIMIT
            smooth_and_whole = lit_from > 0.9 and name != "turbulence"
            target = f"{LIMIT:g} % from HCIPy's" if smooth_and_whole else ""
            rows.append(Row(f"{name}, {lenslets}", percent, target, met if target else None))
    return Table("wavefronts", "Differences of wavefronts at the lenslets' centres, % of the true rms", rows)
