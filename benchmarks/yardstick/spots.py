"""Spots of four origins, without noise, and their true displacements."""

from __future__ import annotations

import contextlib
import io
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.slopes.spots.bounds import poisson_gaussian_information
from faintspot.slopes.spots.shapes import spots
from faintspot.slopes.training.psf_learning import learn_psf_from_images

Floats = NDArray[np.float64]

RANGE_PX = 1.0
"""Displacements are uniform within plus and minus this on each axis."""
SHARED = Path(os.environ.get("FAINTSPOT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
BENCH = SHARED / "data" / "ciao_bench_60x224x224.npz"
_STEP_PX = 0.05
_STEPS = _STEP_PX * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
_LENSLETS, _LENSLET_PX, _PX_PER_WAVE = 7, 12, 2.0
"""Sensors of HCIPy and OOPAO: lenslets across, pixels of each, pixels for a wave of tilt (lambda / d)."""
_BENCH_DARK_ADU, _BIN, _BRIGHT_E = 65.3, 2, 1e5  # the level at which there is no flux between its spots


@dataclass(frozen=True)
class UnitSpots:
    """Images of a flux of 1 e- on average, without noise.

    Attributes
    ----------
    images : (n, ny, nx) array
    position : (n, 2) array
        True position along x and y, px, but for a constant of each lenslet.
    lenslet : (n,) array of int
        Lenslet that made each; its mean error is taken off.
    model : (n, ny, nx) array
        Images that the bound takes to be known: `images`, or of real spots what is smooth of them.
    derivatives : (n, 2, ny, nx) array
        Change of the model for 1 px along x and y.
    """

    images: Floats
    position: Floats
    lenslet: NDArray[np.int64]
    model: Floats
    derivatives: Floats

    def shuffled(self, seed: int) -> UnitSpots:
        """Return the spots in another order: neighbours on a frame that is denoised do not move alike."""
        order = np.random.default_rng([seed, 93]).permutation(len(self.images))
        return UnitSpots(*(getattr(self, field.name)[order] for field in fields(self)))

    def noisy(self, flux_e: float, read_noise_e: float, seed: int) -> NDArray[np.float32]:
        """Return electrons: Poisson noise, and read noise."""
        rng = np.random.default_rng([seed, round(10 * flux_e), round(10 * read_noise_e)])
        electrons = rng.poisson(flux_e * self.images)
        return (electrons + read_noise_e * rng.standard_normal(electrons.shape)).astype(np.float32)

    def bound_px(self, flux_e: float, read_noise_e: float, number: int = 300) -> float:
        """Return the Cramer-Rao bound on the rms error of an axis, for a known spot of unknown flux."""
        pixels = self.images[0].size
        unit = self.model[:number].reshape(-1, 1, pixels)
        mean_e, slopes_e = flux_e * unit, flux_e * self.derivatives[:number].reshape(-1, 2, pixels)
        changes = np.concatenate([slopes_e, unit], axis=1)
        weights = poisson_gaussian_information(np.maximum(mean_e, 1e-12), read_noise_e)
        information = np.einsum("nap,nbp->nab", changes * weights, changes)
        variances = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)[:, :2]
        return float(np.sqrt(variances.mean()))


def _together(parts: list[tuple[Floats, ...]], displacement: Floats) -> UnitSpots:
    """Join frames: windows of each at its displacement and a step to either side along x and y."""
    images = np.maximum([part[0] for part in parts], 0.0)
    along = [np.array([part[i] - part[i + 1] for part in parts]) / (2 * _STEP_PX) for i in (1, 3)]
    n, lenslets, scale = len(images), images.shape[1], images.sum(axis=(2, 3)).mean()
    shape = (n * lenslets, *images.shape[2:])
    unit = images.reshape(shape) / scale
    return UnitSpots(
        unit,
        np.repeat(displacement, lenslets, axis=0),
        np.tile(np.arange(lenslets), n),
        unit,
        np.stack([part.reshape(shape) for part in along], axis=1) / scale,
    )


def _displaced(render: Any, frames: int, seed: int) -> UnitSpots:
    """Render frames at random displacements; `render` takes x and y [px], and returns windows."""
    displacement = np.random.default_rng([seed, 39]).uniform(-RANGE_PX, RANGE_PX, (frames, 2))
    parts = [tuple(render(*(centre + step)) for step in _STEPS) for centre in displacement]
    return _together(parts, displacement)


def ours(number: int, seed: int) -> UnitSpots:
    """Return diffraction spots of square lenslets, sampled at Nyquist, as faintspot simulates them."""

    def render(x: float, y: float) -> Floats:
        return spots(np.array([[x, y]]), shape=(16, 16))

    return _displaced(render, number, seed)


def _tilt_waves(x: float, y: float, points: int) -> Floats:
    """Return the path difference, in waves, that moves every spot by x and y px."""
    along = (np.arange(points) - (points - 1) / 2) / _LENSLET_PX / _PX_PER_WAVE
    return y * along[:, None] + x * along[None, :]


def _windows(frame: Floats) -> Floats:
    side = _LENSLET_PX
    cut = frame.reshape(_LENSLETS, side, _LENSLETS, side).swapaxes(1, 2)
    return cut.reshape(_LENSLETS**2, side, side)


def _fully_lit(flat: Floats) -> NDArray[np.bool_]:
    flux = flat.sum(axis=(1, 2))
    return np.asarray(flux > 0.95 * np.sort(flux)[-5])


def hcipy(number: int, seed: int) -> UnitSpots:
    """Return spots of HCIPy: propagation through all lenslets at once, so that neighbours interfere."""
    from benchmarks.loops.foreign.specula import example

    system = example("hcipy_loop")

    def frame(x: float, y: float) -> Floats:
        path_m = system.SENSING_M * _tilt_waves(x, y, _LENSLETS * _LENSLET_PX).ravel()
        image = system.image(system.noiseless, system.hcipy.Field(path_m, system.grid), 1.0)
        return _windows(np.asarray(image).reshape(_LENSLETS * _LENSLET_PX, -1))

    lit = _fully_lit(frame(0.0, 0.0))
    return _displaced(lambda x, y: frame(x, y)[lit], -(-number // int(lit.sum())), seed).shuffled(seed)


def oopao(number: int, seed: int) -> UnitSpots:
    """Return spots of OOPAO, its images turned over: it swaps x and y within each lenslet."""
    from OOPAO.OPD_map import OPD_map
    from OOPAO.ShackHartmann import ShackHartmann
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope

    points = _LENSLETS * _LENSLET_PX
    with contextlib.redirect_stdout(io.StringIO()):
        telescope = Telescope(resolution=points, diameter=4.2, samplingTime=0.004, centralObstruction=0.25)
        star = Source(optBand="R", magnitude=10)
        star * telescope
        sensor = ShackHartmann(nSubap=_LENSLETS, telescope=telescope, lightRatio=0.5, shannon_sampling=True)

    def frame(x: float, y: float) -> Floats:
        star**telescope * OPD_map(star.wavelength * _tilt_waves(x, y, points)) * sensor
        return _windows(np.asarray(sensor.cam.frame, np.float64)).swapaxes(1, 2)

    lit = _fully_lit(frame(0.0, 0.0))
    return _displaced(lambda x, y: frame(x, y)[lit], -(-number // int(lit.sum())), seed).shuffled(seed)


def real(number: int, seed: int) -> UnitSpots:
    """Return spots of a bench sensor: the mean of 30 bright frames, moved by whole pixels, then binned 2 x 2.

    Odd and even seeds use the first and the last 30 of its 60 frames. Noise in their wings would count as
    information: the bound is that of the PSF, the flux and the background learnt from them.
    """
    with np.load(BENCH) as archive:
        electrons = archive["frames"][30 * (1 - seed % 2) :][:30].mean(axis=0) - _BENCH_DARK_ADU
    layout = fs.Layout.from_frame(_binned(electrons), move_windows=False)
    whole = np.random.default_rng([seed, 39]).integers(-_BIN, _BIN + 1, (-(-number // len(layout)), 2))
    frames = [layout.images(_binned(np.roll(electrons, (y, x), axis=(0, 1)))) for x, y in whole]
    images = np.maximum(np.concatenate(frames), 0.0)
    images /= images.sum(axis=(1, 2)).mean()
    learnt = learn_psf_from_images(_BRIGHT_E * images, rng=np.random.default_rng(1), search_range_px=2.0)
    shape = images.shape[1:]
    share = (learnt.flux_e / _BRIGHT_E)[:, None, None]
    model, *sides = (share * learnt.psf.images(learnt.positions + step, shape) for step in _STEPS)
    derivatives = [(sides[i] - sides[i + 1]) / (2 * _STEP_PX) for i in (0, 2)]
    position, lenslet = (
        np.repeat(whole / _BIN, len(layout), axis=0),
        np.tile(np.arange(len(layout)), len(whole)),
    )
    offsets = (learnt.positions - position).reshape(len(whole), len(layout), 2).mean(axis=0)
    return UnitSpots(
        images,
        position + offsets[lenslet],
        lenslet,
        np.maximum(model, 0.0) + float(learnt.background_e[0]) / _BRIGHT_E,
        np.stack(derivatives, axis=1),
    ).shuffled(seed)


def _binned(frame: Floats) -> Floats:
    rows, columns = (size // _BIN for size in frame.shape)
    return np.asarray(frame.reshape(rows, _BIN, columns, _BIN).sum(axis=(1, 3)))


FAMILIES = {"ours": ours, "HCIPy": hcipy, "OOPAO": oopao, "real": real}
