"""Do the 95 % intervals of modes, rms and PV hold?

Wavefronts of Z2 to Z15, of random size and direction, over full, annular and irregular pupils of square and
hexagonal arrays. A flat reference with noise of its own is subtracted. Most cases simulate slopes with the
errors that spots of the flux have, also elongated ones with correlated errors; some simulate frames, whose
slopes and errors maximum likelihood measures with the known PSF. Left out: modes that
are not fitted, systematic errors of the slopes, motion of the wavefront.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.sensor.pupil import lenslet_outlines, pupil_of
from faintspot.slopes.wavefront.certificate import certify
from faintspot.slopes.wavefront.zernike import mean_gradients, zernike

Floats = NDArray[np.float64]

MODES, PIXELS, READ_NOISE_E, FWHM_PX, POINTS = 14, 12, 2.0, 2.5, 400
REFERENCE_FRAMES, SEED = 3, 61
OF_SLOPES, OF_FRAMES, DRAWS = 400, 60, 2000
"""Wavefronts of a case, and draws of a certificate (a fifth of the usual number)."""
SIZES_PX = 0.0, 0.005, 0.02, 0.08, 0.3
"""Rms of the slopes of a wavefront, one after the other."""
CORRELATION, LEAST, MOST = 0.4, 0.7, 1.4  # of errors of x and y; errors of sub-apertures over the usual one
MODES_WITHIN, RMS_WITHIN = (93.0, 97.0), (92.0, 98.0)


@dataclass(frozen=True)
class Case:
    """A sensor, the flux of a spot in a frame, and the number of frames of a measurement."""

    pupil: str
    flux_e: float
    n_frames: int
    simulates_frames: bool = False


def cases() -> Iterator[Case]:
    """Yield the cases."""
    for pupil in ("full", "annular", "irregular", "hexagonal"):
        for flux_e in (100.0, 1000.0, 10000.0):
            yield Case(pupil, flux_e, {100.0: 5, 1000.0: 1, 10000.0: 20}[flux_e])
    for pupil, flux_e in (("annular", 100.0), ("full", 1000.0), ("irregular", 1000.0), ("hexagonal", 1e4)):
        yield Case(pupil, flux_e, 5, simulates_frames=True)


def layout_of(pupil: str) -> fs.Layout:
    """Return the sensor behind a pupil, of 10 sub-apertures."""
    if pupil == "hexagonal":
        row, column = np.mgrid[:11, :11].reshape(2, -1)
        step = PIXELS + 2
        x, y = step * (column + 0.5 * (row % 2)) + PIXELS, step * np.sqrt(0.75) * row + PIXELS
        middle = x.mean(), y.mean()
        kept = np.hypot(x - middle[0], y - middle[1]) < 5 * step
        centres, cells = np.stack([x, y], axis=-1)[kept], np.stack([row, column], axis=-1)[kept]
        corners = np.rint(centres[:, ::-1] - 0.5 * (PIXELS - 1)).astype(np.int64)
        shape = (step * 12,) * 2
        return fs.Layout(
            shape, (PIXELS,) * 2, corners, centres, cells, geometry="hexagonal", pitch_px=float(step)
        )
    inner = 0.0 if pupil == "full" else 1.5
    layout = fs.Layout.grid((10, 10), pixels=PIXELS, outer_radius=5.0, inner_radius=inner)
    if pupil != "irregular":
        return layout
    row, column = layout.cells.T
    return layout[~((row < 3) & (column > 5)) & ~((row == 6) & (column < 4))]


def run() -> list[Table]:
    """Count the intervals that hold the truth."""
    rows = [row_of(case, seed) for seed, case in enumerate(cases(), start=SEED)]
    names = list(rows[0].values)
    share = {name: float(np.mean([row.values[name] for row in rows])) for name in names}
    rows.append(Row("all", share, "", _met(share)))
    note = (
        f"Z2 to Z{MODES + 1}, slopes of 0 to {max(SIZES_PX):g} px rms; {OF_SLOPES} wavefronts a case from "
        f"slopes, {OF_FRAMES} from frames; reference of {REFERENCE_FRAMES} frames of the same flux, read "
        f"noise {READ_NOISE_E:g} e-, FWHM {FWHM_PX:g} px"
    )
    return [Table("metrology", "95 % intervals that hold the truth (%)", rows, [note])]


def _met(share: dict[str, float]) -> bool:
    within = {"modes (%)": MODES_WITHIN, **{name: RMS_WITHIN for name in share if name.startswith("rms")}}
    return all(low <= share[name] <= high for name, (low, high) in within.items())


def row_of(case: Case, seed: int) -> Row:
    """Return the shares of intervals of a case that hold."""
    rng, layout = np.random.default_rng(seed), layout_of(case.pupil)
    n = OF_FRAMES if case.simulates_frames else OF_SLOPES
    gradients, modes = _gradients(layout), _modes_on_pupil(layout)
    measure: _FromFrames | _FromSlopes
    measure = _FromFrames(layout, case.flux_e) if case.simulates_frames else _FromSlopes(layout, case.flux_e)
    held: dict[str, list[float]] = {}
    for number in range(n):
        true = rng.standard_normal(MODES) / np.arange(2, MODES + 2)
        true *= SIZES_PX[number % len(SIZES_PX)] / np.sqrt(np.mean((gradients @ true) ** 2))
        own = measure(rng, gradients @ true, case.n_frames)
        other = measure(rng, np.zeros(len(gradients)), REFERENCE_FRAMES)
        x, y = (values.mean(axis=0) for values in (other.x, other.y))
        fit = fs.fit_wavefront(replace(own, x=own.x - x, y=own.y - y), layout, modes=MODES)
        fit = replace(fit, subtracted=fs.fit_wavefront(other, layout, modes=MODES))
        coefficients, found = true * fit.pupil.radius_subapertures, certify(fit, draws=DRAWS)
        within = np.abs(fit.mean - coefficients) <= fit.mean_half_width
        held.setdefault("modes (%)", []).append(100 * float(within.mean()))
        for name, projected in modes.items():
            surface, estimate = projected @ coefficients, getattr(found, name)
            size = float(np.ptp(surface) if name.startswith("pv") else surface.std())
            holds = estimate.low <= size + 1e-12 and size <= estimate.high
            held.setdefault(f"{name.replace('_', ' ').replace('pv', 'PV')} (%)", []).append(100.0 * holds)
    share = {name: float(np.mean(values)) for name, values in held.items()}
    frames = f"{case.n_frames} frame{'s' * (case.n_frames > 1)}"
    source = ", simulated frames" if case.simulates_frames else ""
    return Row(f"{case.pupil}, {case.flux_e:g} e-, {frames}{source}", share)


def noise_of(flux_e: float) -> float:
    """Return the error of a slope [px]: photon noise and read noise in an area of the spot."""
    sigma = FWHM_PX / 2.355
    return float(sigma * np.sqrt((1 + 4 * np.pi * sigma**2 * READ_NOISE_E**2 * 2 / flux_e) / flux_e))


def _gradients(layout: fs.Layout) -> Floats:
    pupil = pupil_of(layout)
    outlines = (lenslet_outlines(layout) - pupil.centre_px) / pupil.radius_px
    return np.concatenate(mean_gradients(np.arange(2, 2 + MODES), outlines))


def _modes_on_pupil(layout: fs.Layout) -> dict[str, Floats]:
    """Return the modes over the lit pupil (points, k) by the name of their rms or PV in a certificate.

    Those without tilt or focus are about the best plane or paraboloid.
    """
    pupil, line = pupil_of(layout), (np.arange(POINTS) + 0.5) * 2 / POINTS - 1
    outlines = (lenslet_outlines(layout) - pupil.centre_px) / pupil.radius_px
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    along = np.linspace(0.0, 1.0, 20)[:, None, None, None]
    sides = ((1 - along) * outlines + along * np.roll(outlines, -1, axis=1)).reshape(-1, 2)
    angle = np.linspace(0.0, 2 * np.pi, 2000)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inside, at_edge = (
        np.stack([zernike(j, *points[_lit(points, outlines)].T) for j in range(1, MODES + 2)], axis=-1)
        for points in (grid, np.concatenate([grid, sides, ring]))
    )
    found = {}
    for name, removed in {"": 1, "_without_tilt": 3, "_without_focus": 4}.items():
        share = np.linalg.lstsq(inside[:, :removed], inside, rcond=None)[0]
        for size, modes in (("rms", inside), ("pv", at_edge)):
            found[f"{size}{name}"] = (modes - modes[:, :removed] @ share)[:, 1:]
    return found


def _lit(points: Floats, outlines: Floats) -> NDArray[np.bool_]:
    """Return which points (p, 2) lie in the disk and in one of the outlines."""
    lit = np.zeros(len(points), np.bool_)
    x, y = points.T
    for outline in outlines:
        inside = np.ones(len(points), np.bool_)
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= -1e-9
        lit |= inside
    return np.asarray(lit & (np.hypot(x, y) <= 1 + 1e-9))


class _FromSlopes:
    """Slopes of a wavefront with noise of known covariance."""

    def __init__(self, layout: fs.Layout, flux_e: float) -> None:
        self._usual, self._n = noise_of(flux_e), len(layout)

    def __call__(self, rng: np.random.Generator, slopes: Floats, n_frames: int) -> fs.Slopes:
        """Return measured slopes of n frames of slopes (2 n,)."""
        shape = n_frames, self._n
        error = np.linspace(LEAST, MOST, self._n) * self._usual * np.ones(shape)
        first, second = rng.standard_normal((2, *shape))
        second = CORRELATION * first + np.sqrt(1 - CORRELATION**2) * second
        x, y = (
            part + error * noise for part, noise in zip(np.split(slopes, 2), (first, second), strict=True)
        )
        zero = np.zeros(shape, np.int32)
        errors = (error.astype(np.float32),) * 2
        covariance = (CORRELATION * error**2).astype(np.float32)
        return fs.Slopes(x, y, 1 + 0 * x, zero.astype(np.uint8), zero, zero, *errors, covariance)


class _FromFrames:
    """Slopes that maximum likelihood measures in simulated frames."""

    def __init__(self, layout: fs.Layout, flux_e: float) -> None:
        self._layout, self._flux_e = layout, flux_e
        settings = fs.Settings("ml", search_range_px=PIXELS / 3, spot_fwhm_px=FWHM_PX)
        psf = fs.PSF.analytic("gaussian", size=FWHM_PX / 2)
        camera = fs.Calibration(read_noise_e=READ_NOISE_E)
        self._pipeline = fs.SlopePipeline(layout, settings, camera, psf=psf)

    def __call__(self, rng: np.random.Generator, slopes: Floats, n_frames: int) -> fs.Slopes:
        """Return measured slopes of n frames of slopes (2 n,)."""
        frames, _ = fs.slopes.simulate.sensor_frames(
            self._layout,
            n_frames,
            flux_e=self._flux_e,
            positions=slopes.reshape(2, -1).T + self._layout.offsets,
            profile="gaussian",
            size=FWHM_PX / 2,
            detector=Detector(read_noise_e=READ_NOISE_E),
            rng=rng,
        )
        return self._pipeline(frames)
