"""Candidates: this package's estimators, and denoisers of others, each with the settings to choose from."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.yardstick.network import Network
from benchmarks.yardstick.spots import Floats
from faintspot.slopes.estimators.noise import suggested_strength
from faintspot.slopes.training.psf_learning import LearntPSF

Images = NDArray[Any]
Measure = Callable[[Images], Floats]
"""From images (n, ny, nx) in electrons to positions (n, 2)."""
Denoise = Callable[[Images], Images]

SEARCH_PX, BRIGHT_E = 2.0, 3000.0
BM3D = "BM3D"
_KEPT = (6, 9, 12, 16, 24, 40)
_STRENGTHS, _FACTORS, _FEW_FACTORS = (0.5, 0.8, 1.1, 1.5), (0.4, 0.8, 1.3, 2.0), (0.7, 1.2)


@dataclass(frozen=True)
class Known:
    """What a telescope knows: PSF and background of a bright star, mean flux, read noise, and its windows.

    The network was trained on spots of that optics.
    """

    learnt: LearntPSF
    network: Network
    shape: tuple[int, int]
    flux_e: float = 0.0
    read_noise_e: float = 0.0

    @property
    def background_e(self) -> float:
        """Flux of each pixel that is not the spot's."""
        return max(float(self.learnt.background_e[0]), 0.0) * self.flux_e / BRIGHT_E

    @property
    def strength_e(self) -> float:
        """Strength of TV that the package suggests."""
        return float(suggested_strength(self.read_noise_e, self.flux_e, int(np.prod(self.shape))))

    def measured(self, name: str, **settings: Any) -> Measure:
        """Return an estimator on images from which the background has been taken."""
        camera = fs.Calibration(dark=0.0, read_noise_e=self.read_noise_e, background_e=self.background_e)
        spot = fs.PSF(self.learnt.psf.samples, self.learnt.psf.oversampling)
        chosen = fs.Settings(name, **settings)

        @lru_cache(1)
        def pipeline(number: int) -> fs.SlopePipeline:
            layout = fs.Layout.stacked(number, self.shape)
            return fs.SlopePipeline(layout, chosen, camera, psf=spot, threads=1)

        def measure(images: Images) -> Floats:
            slopes = pipeline(len(images))(images.reshape(-1, images.shape[2]))
            return np.stack([slopes.x, slopes.y], axis=1)

        return measure


def centroids(known: Known) -> dict[str, Measure]:
    """Return the centroids among which each denoiser finds its best; the first three are tried with all."""
    near, flux = {"search_range_px": SEARCH_PX}, known.flux_e
    found = {"weights of 3 px": known.measured("weighted", weight_fwhm_px=3.0, **near)}
    found |= {
        f"{k} brightest": known.measured("brightest", keep_brightest=k, **near)
        for k in (12, 24, 6, 9, 16, 40)
    }
    for width in (2.0, 2.5, 4.0):
        found[f"weights of {width:g} px"] = known.measured("weighted", weight_fwhm_px=width, **near)
    for level in (0.01 * flux, 0.04 * flux, known.read_noise_e, 2 * known.read_noise_e):
        found[f"above {level:.2g} e-"] = known.measured("thresholded", threshold_e=level, **near)
    found["window of 4.5 px"] = known.measured("window", window_fwhm_px=4.5, flux_e=flux)
    found["whole window"] = known.measured("centroid", **near)
    return found


def estimators(known: Known) -> dict[str, dict[str, Measure]]:
    """Return this package's estimators with their settings."""
    near: dict[str, Any] = {"search_range_px": SEARCH_PX}
    flux: dict[str, Any] = {"flux_e": known.flux_e}
    strength = known.strength_e
    denoising = {
        "tv": ("noise_std", [strength * factor for factor in _STRENGTHS]),
        "smoothed": ("smoothing_px", [0.5, 0.7, 1.0, 1.4]),
    }
    return {
        **{
            name: {
                f"{value:.2g} {option}, {k} brightest": known.measured(
                    name, keep_brightest=k, **{option: value}, **near
                )
                for value in values
                for k in _KEPT
            }
            for name, (option, values) in denoising.items()
        },
        "window": {
            f"{w:g} px": known.measured("window", window_fwhm_px=w, **flux) for w in (2.5, 3.5, 4.5, 6.0)
        },
        "weighted": {
            f"{w:g} px": known.measured("weighted", weight_fwhm_px=w, **near) for w in (2.0, 2.5, 3.0, 4.0)
        },
        "ml": {"": known.measured("ml", weight_floor=0.001, **near)},
        "map": {"": known.measured("map", weight_floor=0.001, **flux, **near)},
        "network, position": {"": lambda images: known.network(images, known.flux_e, known.read_noise_e)[1]},
    }


def denoisers(known: Known, *, slow: bool) -> dict[str, dict[str, Denoise]]:
    """Return denoisers of images with their settings; those whose package is absent are left out."""
    found: dict[str, dict[str, Denoise]] = {
        "none": {"": lambda images: images},
        "tv, any centroid": {
            f"{factor} of the noise": partial(fs.tv_denoise, noise_std=factor * known.strength_e)
            for factor in _STRENGTHS
        },
        "network, image": {"": lambda images: known.network(images, known.flux_e, known.read_noise_e)[0]},
    }
    for name, denoise in _denoisers_of_frames():
        if slow or name != BM3D:
            found[name] = dict(_settings(known, denoise, _FEW_FACTORS if name == BM3D else _FACTORS))
    return found


def _denoisers_of_frames() -> Iterator[tuple[str, Callable[[Images, float], Images]]]:
    """Yield functions of a frame and the standard deviation of its noise."""
    if find_spec("skimage"):
        from skimage import restoration

        yield (
            "non-local means",
            lambda frame, noise: restoration.denoise_nl_means(
                frame, patch_size=3, patch_distance=5, h=0.8 * noise, sigma=noise
            ),
        )
        yield (
            "wavelets",
            lambda frame, noise: restoration.cycle_spin(
                frame,
                restoration.denoise_wavelet,
                max_shifts=1,
                func_kw={"sigma": noise, "rescale_sigma": True},
                workers=1,
            ),
        )
        yield (
            "bilateral",
            lambda frame, noise: (
                restoration.denoise_bilateral(frame - frame.min(), sigma_color=3 * noise, sigma_spatial=1.0)
                + frame.min()
            ),
        )
        yield (
            "scikit-image's TV",
            lambda frame, noise: restoration.denoise_tv_chambolle(frame, weight=noise, max_num_iter=100),
        )
    if find_spec("bm3d"):
        import bm3d

        yield BM3D, bm3d.bm3d


def _settings(
    known: Known, denoise: Callable[[Images, float], Images], factors: tuple[float, ...]
) -> Iterator[tuple[str, Denoise]]:
    """Yield ways to denoise frames of the images: electrons or their Anscombe transform, by strength."""
    noise = np.sqrt(known.read_noise_e**2 + known.flux_e / np.prod(known.shape))
    offset = known.read_noise_e**2 + known.background_e + 3 / 8

    def plain(images: Images, factor: float) -> Images:
        return _untiled(denoise(_tiled(images), factor * noise), images)

    def stabilised(images: Images, factor: float) -> Images:
        root = 2 * np.sqrt(np.maximum(images + offset, 0.0))
        return np.square(_untiled(denoise(_tiled(root), factor), images) / 2) - np.float32(offset)

    for factor in factors:
        yield f"{factor} of the noise", partial(plain, factor=factor)
        yield f"{factor} of the noise, Anscombe", partial(stabilised, factor=factor)


def _tiled(images: Images) -> Images:
    """Lay images side by side, as on a camera; the first ones again fill the last row of the frame."""
    across = int(np.ceil(np.sqrt(len(images))))
    rows = -(-len(images) // across)
    filled = np.resize(images, (rows, across, *images.shape[1:])).astype(np.float64)
    return filled.swapaxes(1, 2).reshape(rows * images.shape[1], -1)


def _untiled(frame: Images, like: Images) -> Images:
    _, ny, nx = like.shape
    windows = np.asarray(frame).reshape(len(frame) // ny, ny, -1, nx).swapaxes(1, 2)
    return windows.reshape(-1, ny, nx)[: len(like)].astype(np.float32)
