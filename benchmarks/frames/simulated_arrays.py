"""Random Shack-Hartmann frames with a known layout, for `benchmarks.frames.layouts`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.wavefront.zernike import zernike

Floats = NDArray[np.float64]
Points = NDArray[np.complex128]
RATIOS = {"square": 1j, "hexagonal": complex(np.exp(1j * np.pi / 3))}
LIT, DARK = 0.6, 0.1
"""Flux relative to the median of full lenslets: from LIT on a window is due, below DARK it is wrong."""
_SIDES_PX, _SHARES = (220, 420, 900), (0.75, 0.22, 0.03)  # largest frames, and how often they are drawn
_FWHM = 2.3548  # of a Gaussian, in standard deviations


@dataclass(frozen=True)
class Array:
    """One frame and what is known about it.

    Parameters
    ----------
    frame : array (ny, nx)
    geometry : str
    nodes, spots : complex arrays (n,)
        Regular lattice and true positions of the spots, x + 1j * y [px].
    flux : array (n,)
        Flux relative to the median of the fully illuminated lenslets.
    either : bool array (n,)
        Lenslets that may have a window or not: at the edge of the frame, under a reflection, dead.
    kinds : tuple of str
        Kinds of frame that this one counts for.
    signal_to_noise : float
        Of a typical spot in a matched filter; infinite without noise.
    reflection : (complex, float)
        Centre and radius of the disk in which a reflection hides or imitates spots [px].
    """

    frame: NDArray[Any]
    geometry: str
    nodes: Points
    spots: Points
    flux: Floats
    either: NDArray[np.bool_]
    kinds: tuple[str, ...]
    signal_to_noise: float = np.inf
    reflection: tuple[complex, float] = (0j, 0.0)

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Lenslets that need a window."""
        return (self.flux >= LIT) & ~self.either


def gaussians(shape: tuple[int, int], at: Points, peak: Any, width_px: float) -> Floats:
    """Return the sum of Gaussians of one width (standard deviation) at x + 1j * y."""
    y, x = (
        np.exp(-0.5 * ((np.arange(n) - centre[:, None]) / width_px) ** 2)
        for n, centre in zip(shape, (at.imag, at.real), strict=True)
    )
    return np.asarray((y * np.broadcast_to(peak, len(at))[:, None]).T @ x)


def plain_small(count: int = 160) -> list[Array]:
    """Return small arrays of bright, equal spots: 4 x 4 to 7 x 7, peak 250, noise of 1 to 5."""
    arrays = []
    for index in range(count):
        n = 4 + index % 4
        pitch, fwhm = ((16.0, 3.0), (20.0, 3.5), (24.0, 4.0), (12.0, 3.0), (30.0, 5.0))[index // 4 % 5]
        shape, jitter = (("square", 1.0), ("annulus", 1.0), ("round", 1.0), ("square", 0.0))[index // 20 % 4]
        arrays.append(_plain(n, pitch, fwhm, shape, jitter, 1.0 + index % 5, index))
    return arrays


def _plain(n: int, pitch: float, fwhm: float, shape: str, jitter: float, noise: float, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    size = round(n * pitch + 40)
    offset = np.arange(n) - (n - 1) / 2
    cells: Points = (offset + 1j * offset[:, None]).ravel()
    if shape != "square":
        cells = cells[(np.abs(cells) <= n / 2) & (np.abs(cells) >= (n / 6 if shape == "annulus" else 0))]
    middle = (size - 1) / 2 * (1 + 1j) + complex(*rng.uniform(-0.5, 0.5, 2))
    nodes = middle + pitch * cells
    spots = nodes + jitter * (rng.standard_normal(len(nodes)) + 1j * rng.standard_normal(len(nodes)))
    frame = gaussians((size, size), spots, 250.0, fwhm / _FWHM) + rng.normal(10, noise, (size, size))
    either = np.zeros(len(nodes), dtype=bool)
    return Array(frame.astype(np.float32), "square", nodes, spots, np.ones(len(nodes)), either, ())


def random_array(seed: int, index: int) -> Array:
    """Return a random array with at least 4 lenslets to judge; each index has random numbers of its own."""
    return _judged(_Draw, np.random.default_rng([seed, index]))


def aberrated_array(seed: int, index: int) -> Array:
    """Return a random array of 3 to 15 lenslets across, with displacements of up to half a pitch."""
    return _judged(_AberratedDraw, np.random.default_rng([seed, index, 1]))


def _judged(draw: type["_Draw"], rng: np.random.Generator) -> Array:
    array = draw(rng).array()
    while np.count_nonzero(array.lit) < 4:
        array = draw(rng).array()
    return array


class _Draw:
    """Draws of one random array, in the order in which its parts depend on each other."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.kinds: list[str] = []
        self.geometry = str(rng.choice(list(RATIOS)))
        self.pupil = str(rng.choice(["full", "disk", "annulus", "spiders"]))
        fewest = {"full": 3, "disk": 4, "annulus": 6, "spiders": 8}[self.pupil]
        self.n = round(self.log(fewest, 80.49))
        side = max(float(rng.choice(_SIDES_PX, p=_SHARES)), 5.5 * (self.n + 2))
        self.pitch = self.log(5.0, min(250.0, side / (self.n + 1)))
        self.width = max(self.pitch * self.log(0.05, 0.2), 0.7)
        self.angle = rng.uniform(0, 2 * np.pi) if self.chance(0.6) else np.radians(rng.normal(0, 0.5))

    def chance(self, part: float, kind: str = "") -> bool:
        """Return True in this part of the draws, which then count for a kind."""
        chosen = bool(self.rng.random() < part)
        if chosen and kind:
            self.kinds.append(kind)
        return chosen

    def log(self, low: float, high: float) -> float:
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def complex_normal(self, count: int) -> Points:
        return np.asarray(self.rng.standard_normal(count) + 1j * self.rng.standard_normal(count))

    def array(self) -> Array:
        rng = self.rng
        away, flux = self.lenslets()
        away, flux = away[flux > 0.01], flux[flux > 0.01]
        shifts = self.aberrations(away)
        at = self.pitch * np.exp(1j * self.angle) * away
        shape, middle = self.frame_for(at)
        nodes, spots = middle + at, middle + at + self.pitch * np.exp(1j * self.angle) * shifts
        flux = flux * self.illumination(away)
        flux /= np.median(flux[flux > 0.5 * np.median(flux)])
        either = ~self.inside(nodes, shape) | ~self.inside(spots, shape)
        if self.chance(0.15, "dead lenslets"):
            dead = rng.permutation(len(flux))[: max(1, round(rng.uniform(0, 0.05) * len(flux)))]
            flux[dead], either[dead] = 0.0, True
        image = gaussians(shape, spots, flux, self.width)
        image += self.background(shape, middle)
        reflection = 0j, 0.0
        if self.chance(0.12, "reflection"):
            where = complex(rng.uniform(0, shape[1]), rng.uniform(0, shape[0]))
            size = rng.uniform(0.5, 2.0) * self.pitch
            image += gaussians(shape, np.array([where]), self.log(1.0, 20.0), size)
            reflection = where, 3 * size + 0.5 * self.pitch
            either |= np.abs(spots - where) < reflection[1]
        if self.chance(0.1, "ghosts"):
            ghosts = rng.uniform(0, shape[1], 3) + 1j * rng.uniform(0, shape[0], 3)
            image += gaussians(shape, ghosts, rng.uniform(0.05, 0.2, 3), self.width)
        frame, ratio = self.detected(image)
        self.kinds += [self.geometry, self.pupil, self.sizes(), "S/N > 20" if ratio > 20 else "S/N 5 to 20"]
        if self.width > 0.14 * self.pitch:
            self.kinds.append("wide spots")
        kinds = tuple(self.kinds)
        return Array(frame, self.geometry, nodes, spots, flux, either, kinds, ratio, reflection)

    def sizes(self) -> str:
        return "3 to 7 across" if self.n < 8 else "8 to 20 across" if self.n < 21 else "21 to 80 across"

    def lenslets(self) -> tuple[Points, Floats]:
        """Return the lenslets in pitches from the middle, and the part of each within the pupil."""
        count = np.arange(-2 * self.n, 2 * self.n + 1)
        cells = (count + count[:, None] * RATIOS[self.geometry]).ravel()
        if self.pupil == "full":
            half = np.array([1.0, self.rng.uniform(0.7, 1.0) if self.n > 4 else 1.0]) * self.n / 2
            cells = cells + (0.5 + 0.5j if self.n % 2 == 0 else 0)
            held = (np.abs(cells.real) < half[0]) & (np.abs(cells.imag) < half[1])
            return cells[held], np.ones(np.count_nonzero(held))
        cells = cells + complex(*self.rng.uniform(-0.5, 0.5, 2))
        cells = cells[np.abs(cells) < self.n / 2 + 1]
        inner = 0.0 if self.pupil == "disk" else self.rng.uniform(0.15, 0.4)
        spider = self.rng.uniform(0.1, 0.6) if self.pupil == "spiders" else 0.0
        turn = np.exp(1j * self.rng.uniform(0, np.pi))
        step = (np.arange(5) - 2) / 5
        points = cells[:, None] + (step + 1j * step[:, None]).ravel()
        open_ = (np.abs(points) < self.n / 2) & (np.abs(points) >= inner * self.n / 2)
        arms = points * turn
        open_ &= np.minimum(np.abs(arms.real), np.abs(arms.imag)) >= spider / 2
        return cells, open_.mean(axis=1)

    def aberrations(self, away: Points) -> Points:
        """Return the displacements of the spots in pitches: jitter, defocus and coma."""
        rms = self.rng.uniform(0, 0.02)
        if self.chance(0.5):
            rms = self.rng.uniform(0, 0.08)
        if rms > 0.04:
            self.kinds.append("jitter > 0.04 pitch")
        shifts = rms * self.complex_normal(len(away))
        if self.chance(0.3, "defocus"):
            # The search ends at a pitch of 5 px.
            shifts += max(self.rng.uniform(-0.1, 0.1), 5.0 / self.pitch - 1) * away
        if self.n >= 8 and self.chance(0.2, "coma"):
            axis = np.exp(1j * self.rng.uniform(0, 2 * np.pi))
            x, y = (away / axis / (self.n / 2)).real, (away / axis / (self.n / 2)).imag
            coma = self.rng.uniform(0, min(0.08 * self.n, 1.2))
            # The gradient of r^3 sin(theta).
            shifts += coma / 9 * (6 * x * y + 1j * (3 * x**2 + 9 * y**2)) * axis
        return shifts

    def frame_for(self, at: Points) -> tuple[tuple[int, int], complex]:
        """Return the shape of a frame and the position of the middle of the array in it."""
        margin = self.rng.uniform(0.6, 2.0) * self.pitch * np.ones(2)
        margin[self.rng.integers(2)] *= self.rng.uniform(1.0, 2.0)
        x, y = at.real, at.imag
        extent = np.array([np.ptp(x), np.ptp(y)]) + 2 * margin
        corner = -np.array([x.min(), y.min()]) + margin + self.rng.uniform(-0.4, 0.4, 2) * self.pitch
        if self.chance(0.12, "cut by the frame"):
            corner[self.rng.integers(2)] -= margin.max() * self.rng.uniform(0.7, 1.4)
        return (round(extent[1]), round(extent[0])), complex(*corner)

    def inside(self, at: Points, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Return whether the window of each position is within the frame."""
        margin = 0.55 * self.pitch + 1.0
        x, y = at.real, at.imag
        held = (np.minimum(x, y) > margin) & (x < shape[1] - 1 - margin) & (y < shape[0] - 1 - margin)
        return np.asarray(held)

    def illumination(self, away: Points) -> Floats:
        """Return the relative flux of fully open lenslets: scatter and gradients."""
        flux = np.exp(self.rng.uniform(0, 0.2) * self.rng.standard_normal(len(away)))
        radius = away / (self.n / 2)
        if self.chance(0.3, "flux gradient"):
            flux *= 1 + self.rng.uniform(0, 0.4) * (radius * np.exp(2j * np.pi * self.rng.random())).real
            flux *= np.exp(-self.rng.uniform(0, 0.6) * np.abs(radius) ** 2)
        return flux

    def background(self, shape: tuple[int, int], middle: complex) -> Floats:
        y, x = np.mgrid[: shape[0], : shape[1]] / max(shape)
        image = self.rng.uniform(0, 2) * np.ones(shape)
        if self.chance(0.3, "background gradient"):
            image += self.rng.uniform(-1, 1) * x + self.rng.uniform(-1, 1) * y
        if self.chance(0.2, "haze"):
            wide = max(self.n * self.pitch * self.rng.uniform(0.3, 0.6), 1.5 * self.pitch)
            image += gaussians(shape, np.array([middle]), self.rng.uniform(0.1, 1.0), wide)
        return np.asarray(image - image.min())  # cameras have an offset: no flux is cut off at 0

    def detected(self, image: Floats) -> tuple[NDArray[Any], float]:
        """Return the frame in camera units, with noise and hot pixels, and its signal-to-noise ratio."""
        rng = self.rng
        ratio = np.inf if self.chance(0.1, "no noise") else self.log(5.0, 500.0)
        # The signal-to-noise ratio of a Gaussian of peak 1 in white noise: width * sqrt(pi) / noise.
        noise = self.width * np.sqrt(np.pi) / ratio
        shot = rng.uniform(0, 1) * noise**2 if self.chance(0.5) else 0.0
        image = image + np.sqrt(noise**2 + shot * image.clip(0)) * rng.standard_normal(image.shape)
        if self.chance(0.3, "hot pixels"):
            count = max(1, round(self.log(1e-4, 2e-3) * image.size))
            image.ravel()[rng.integers(0, image.size, count)] += rng.uniform(0.3, 5.0, count)
        kind = str(rng.choice(["uint8", "uint16", "float32"], p=[0.15, 0.45, 0.4]))
        self.kinds.append(kind)
        if kind == "float32":
            return (image * self.log(1e-3, 1e4)).astype(np.float32), ratio
        most = np.iinfo(kind).max
        scale = most / 4 * self.log(0.2, 1.0) if kind == "uint8" else self.log(100, 15_000)
        # Rounding to whole numbers has a standard deviation of 1 / sqrt(12).
        ratio = self.width * np.sqrt(np.pi) / np.hypot(noise, 1 / np.sqrt(12) / scale)
        counts = np.rint(image * scale + 5 * noise * scale)
        return np.clip(counts, 0, most).astype(kind), ratio if noise else np.inf


class _AberratedDraw(_Draw):
    """Draws of small arrays with Zernike modes from focus to the fourth radial order."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self.pupil = str(rng.choice(["full", "disk", "annulus"]))
        self.n = round(self.log(6 if self.pupil == "annulus" else 3, 15.49))
        self.pitch = self.log(8.0, 40.0)
        self.width = max(self.pitch * self.log(0.05, 0.2), 0.7)

    def sizes(self) -> str:
        return "3 to 5 across" if self.n < 6 else "6 to 15 across"

    def aberrations(self, away: Points) -> Points:
        at, modes = away / (self.n / 2), np.arange(4, 16)
        size, step = self.rng.standard_normal(len(modes)) / (modes - 2), 1e-3

        def wavefront(points: Points) -> Floats:
            return np.asarray(
                sum(a * zernike(int(j), points.real, points.imag) for j, a in zip(modes, size, strict=True))
            )

        shifts = wavefront(at + step) - wavefront(at - step)
        shifts = shifts + 1j * (wavefront(at + 1j * step) - wavefront(at - 1j * step))
        largest = self.rng.uniform(0, 0.5)
        self.kinds.append("aberrations below .3" if largest < 0.3 else "aberrations of .3 to .5")
        jitter = self.rng.uniform(0, 0.02) * self.complex_normal(len(away))
        return np.asarray(largest * shifts / np.abs(shifts).max() + jitter)
