"""Open-loop movies of spots that other packages make, without noise, and the truth of their turbulence."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.foreign.base import Floats
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M, structure_function

OUTER_SCALE_M = 25.0
FRAMES = 2000
_PATHS_EVERY = 10  # frames, of which the wavefront is kept
_ILLUMINATED = 0.5  # of the brightest lenslet
_SEPARATIONS = (4, 7, 10, 14)  # points, 0.2 to 0.8 m


@dataclass(frozen=True)
class Night:
    """Telescope and turbulence of a package."""

    tool: str
    r0_m: float
    """At 500 nm, as given to the package."""
    shares: tuple[float, ...]
    winds: tuple[tuple[float, float], ...]
    """Speed, m/s, and direction, degrees, from columns to rows of the frames."""
    diameter_m: float
    pixel_scale_arcsec: float
    lenslet_px: int
    make: Callable[[Path, int, int], tuple[Any, Any]]
    """From folder, seed and number of frames to frames and paths, m."""
    rate_hz: float = 250.0

    def read_noise_e(self, flux_e: float) -> float:
        """Return the read noise, e-."""
        return 3.0 if self.tool == "oopao" and flux_e < 100 else 1.0

    @property
    def tau0_ms(self) -> float:
        """Coherence time, of the stated r0."""
        speeds = np.array([speed for speed, _ in self.winds])
        mean = (np.array(self.shares) @ speeds ** (5 / 3) / sum(self.shares)) ** 0.6
        return float(314 * self.r0_m / mean)


def movie(night: Night, folder: Path, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return frames with a mean flux of 1 in an illuminated lenslet, and some wavefronts; made once."""
    file = folder / f"night-{night.tool}-{seed}.npz"
    if not file.exists():
        frames, paths_m = night.make(folder, seed, FRAMES)
        unfinished = file.with_suffix(".part.npz")
        np.savez(unfinished, frames=np.float32(frames), paths_m=np.float32(paths_m[::_PATHS_EVERY]))
        unfinished.replace(file)
    with np.load(file) as stored:
        frames, paths_m = stored["frames"], stored["paths_m"]
    rows, columns = (length // night.lenslet_px for length in frames.shape[1:])
    mean = frames.mean(axis=0).reshape(rows, night.lenslet_px, columns, night.lenslet_px).sum(axis=(1, 3))
    return frames / mean[mean > _ILLUMINATED * mean.max()].mean(), paths_m


def r0_of_paths(paths_m: NDArray[np.float32], step_m: float) -> float:
    """Return r0 at 500 nm from the structure function of wavefronts, which are NaN outside the pupil."""
    r0 = []
    for separation in _SEPARATIONS:
        differences = [
            np.diff(np.stack([first, second]), axis=0)[0]
            for first, second in (
                (paths_m[:, separation:], paths_m[:, :-separation]),
                (paths_m[:, :, separation:], paths_m[:, :, :-separation]),
            )
        ]
        variance = np.mean([np.nanmean(np.square(each, dtype=np.float64)) for each in differences])
        variance *= (2 * np.pi / R0_WAVELENGTH_M) ** 2
        expected = float(structure_function(np.array([separation * step_m]), OUTER_SCALE_M)[0])
        r0.append((variance / expected) ** (-3 / 5))
    return float(np.mean(r0))


def _of_loop(loop: Any, seed: int, frames: int) -> tuple[Any, Any]:
    """Return frames and paths of a loop that is not closed."""
    images = np.array([loop.image(path_m) for path_m in loop.paths_m(seed, frames)], np.float32)
    return images, loop.wavefronts(loop.paths_m(seed, frames))


def _oopao(folder: Path, seed: int, frames: int) -> tuple[Floats, Floats]:
    from benchmarks.loops.foreign.oopao import OopaoCase, OopaoLoop

    return _of_loop(OopaoLoop(OopaoCase("night", flux_e=1.0), folder), seed, frames)


def _hcipy(folder: Path, seed: int, frames: int) -> tuple[Floats, Floats]:
    from benchmarks.loops.foreign.hcipy import HcipyLoop

    return _of_loop(HcipyLoop(1.0, folder), seed, frames)


def _soapy(folder: Path, seed: int, frames: int) -> tuple[Floats, Floats]:
    from benchmarks.loops.foreign.soapy import SoapyLoop

    return _of_loop(SoapyLoop(1.0, folder), seed, frames)


def _specula(folder: Path, seed: int, frames: int) -> tuple[Floats, Floats]:
    from benchmarks.loops.foreign.specula import open_loop

    return open_loop(seed, frames)


_THREE = (0.5, 0.3, 0.2)
NIGHTS = (
    Night(
        "oopao",
        0.25,
        (0.45, 0.25, 0.15, 0.15),
        ((6, 20), (9, 80), (14, 150), (22, 250)),
        4.2,
        0.11,
        12,
        _oopao,
    ),
    Night("specula", 0.1438, _THREE, ((8, 160), (12, 70), (20, 340)), 3.6, 0.11, 10, _specula),
    Night("hcipy", 0.2, _THREE, ((6, 200), (12, 290), (20, 50)), 4.2, 0.1117, 12, _hcipy),
    Night("soapy", 0.2, _THREE, ((6, 90), (12, 0), (20, 180)), 4.2, 0.15, 12, _soapy),
)
