"""Sensor of a laser guide star: each lenslet's image of a point, convolved with that of the sodium layer."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.telescope.wavefront_sensor import ShackHartmann
from faintspot.loop.turbulence.slope_covariance import ARCSEC
from faintspot.slopes.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.slopes.spots.psf import PSF

Floats = NDArray[np.float32]

_NODES = 3  # per pixel: a point's image has no structure that wide beams would not blur
_JITTER = 7  # of a frame's random numbers


def subaperture_centres_m(configuration: LoopConfiguration, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return x and y of the centres of sub-apertures, from the centre of the pupil, (n, 2)."""
    middle = 0.5 * (configuration.sensor.subapertures - 1)
    return np.asarray((cells[:, ::-1] - middle) * configuration.subaperture_m, np.float64)


def laser_guide_star(
    configuration: LoopConfiguration, cells: NDArray[np.int64], spot_fwhm_arcsec: float
) -> LaserGuideStar:
    """Return the star as sub-apertures see it, with a Gaussian spot at a single altitude."""
    laser = not_none(configuration.laser)
    pixel_arcsec = configuration.pixel_scale_rad / ARCSEC
    return LaserGuideStar(
        subaperture_centres_m(configuration, cells),
        laser.launch_m,
        pixel_arcsec,
        gaussian_spot(spot_fwhm_arcsec / pixel_arcsec),
        laser.zenith_distance_deg,
        laser.site_altitude_m,
        laser.focus_altitude_m,
    )


@dataclass(frozen=True, eq=False)
class ElongatedShackHartmann(ShackHartmann):
    """Lenslets that see a laser guide star; `row_pixels` and `column_pixels` lead to fine nodes of an image.

    The image of a point at the focus is taken on nodes within its unaliased field, and convolved with the
    image of the sodium layer, which has the beam's width and is integrated over the pixels.
    """

    along_y: Floats
    """(n, pixels * rank, nodes): from nodes to rows, for each separable term."""
    along_x: Floats
    """(n, rank * nodes, pixels)"""

    def spots(self, wavefront_nm: NDArray[np.floating], displacement_px: float = 0.0) -> Floats:
        """See `ShackHartmann.spots`."""
        fine = super().spots(wavefront_nm, displacement_px)
        n, pixels = len(fine), self.along_x.shape[-1]
        rows = np.matmul(self.along_y, fine).reshape(n, pixels, -1)
        images: Floats = np.matmul(rows, self.along_x)
        return np.maximum(images, 0.0)  # of splines and truncated sums


class LaserSource:
    """The laser guide star of a configuration: the sensor at every time.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    sensor : ShackHartmann
        Sensor without it.
    """

    def __init__(self, configuration: LoopConfiguration, sensor: ShackHartmann) -> None:
        laser = not_none(configuration.laser)
        self._laser, self._rate_hz = laser, configuration.control.frame_rate_hz
        self._fine = _with_nodes(configuration, sensor)
        star = laser_guide_star(configuration, sensor.layout.cells, laser.spot_fwhm_arcsec)
        nodes = _node_places(configuration)
        radius = float(np.abs(nodes).max()) + 0.5 * configuration.sensor.pixels
        self._terms = [
            _terms(star.psf(profile, radius_px=radius, oversampling=_NODES), configuration, nodes)
            for profile in laser.profiles()
        ]
        self._cached: tuple[tuple[tuple[int, float], ...], ElongatedShackHartmann] | None = None
        line = (np.arange(sensor.points) + 0.5) / sensor.amplitude.shape[-1]
        pixel_arcsec = configuration.pixel_scale_rad / ARCSEC
        self._tilt_nm = (line - line.mean()) * (laser.jitter_arcsec / pixel_arcsec / sensor.px_per_nm)

    def sensor(self, frame: int) -> ElongatedShackHartmann:
        """Return the sensor with the sodium layer of a frame."""
        shares = tuple(self._laser.shares(frame / self._rate_hz))
        if self._cached is None or self._cached[0] != shares:
            blocks = [(share, *self._terms[number]) for number, share in shares]
            along_y = np.concatenate([np.float32(share) * y for share, y, _ in blocks], axis=2)
            along_x = np.concatenate([x for *_, x in blocks], axis=1)
            n, pixels, rank, nodes = along_y.shape
            parts = {item.name: getattr(self._fine, item.name) for item in fields(ShackHartmann)}
            sensor = ElongatedShackHartmann(
                **parts,
                along_y=along_y.reshape(n, pixels * rank, nodes),
                along_x=along_x.reshape(n, rank * nodes, pixels),
            )
            self._cached = shares, sensor
        return self._cached[1]

    def jittered(self, wavefront_nm: NDArray[np.floating], seed: tuple[int, ...]) -> NDArray[np.floating]:
        """Return the wavefront with the tilt by which the beam moves all spots."""
        if self._laser.jitter_arcsec == 0:
            return wavefront_nm
        x, y = np.random.default_rng([*seed, _JITTER]).standard_normal(2)
        tilted: NDArray[np.floating] = wavefront_nm + (x * self._tilt_nm + y * self._tilt_nm[:, None]).astype(
            np.float32
        )
        return tilted


def image_reach_px(configuration: LoopConfiguration) -> float:
    """Return the half width of the field of a lenslet that does not alias [px]."""
    return 0.5 * configuration.sensor.samples * configuration.spot_width_px


def _node_places(configuration: LoopConfiguration) -> NDArray[np.float64]:
    """Return the places of nodes from the window's centre [px], as far from pixels' centres as nodes are."""
    count = math.floor(2 * image_reach_px(configuration) * _NODES)
    even = configuration.sensor.pixels % 2 == 0
    count -= (count % 2 == 0) != even  # symmetric, and pixels' centres fall on nodes of the beam's image
    return (np.arange(count) - 0.5 * (count - 1)) / _NODES


def _with_nodes(configuration: LoopConfiguration, sensor: ShackHartmann) -> ShackHartmann:
    """Return the sensor whose images are samples on nodes."""
    samples, width = configuration.sensor.samples, configuration.spot_width_px
    angle = _node_places(configuration) / width  # in lambda / d
    line = (np.arange(samples) + 0.5) / samples - 0.5
    square = np.sinc(angle / samples) / samples
    transform = (np.exp(-2j * np.pi * np.outer(angle, line)) * square[:, None]).astype(np.complex64)
    weights = np.eye(len(angle), dtype=np.float32) / np.float32(width * _NODES)
    return replace(sensor, rows=transform, columns=transform, row_pixels=weights, column_pixels=weights)


def _terms(
    psf: PSF, configuration: LoopConfiguration, nodes_px: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the convolution with each PSF as separable terms from nodes to pixels.

    Returns
    -------
    along_y : (n, pixels, rank, nodes) array
    along_x : (n, rank, nodes, pixels) array
    """
    pixels = configuration.sensor.pixels
    pixels_px = np.arange(pixels) - 0.5 * (pixels - 1)
    steps = (pixels_px[:, None] - nodes_px) * psf.oversampling
    terms = []
    for profile in psf.separable_terms[::-1]:  # y, then x: (n, rank, samples)
        half = (profile.shape[2] - 1) // 2
        index = np.rint(steps).astype(np.int64) + half
        inside = (index >= 0) & (index < profile.shape[2])
        terms.append(np.where(inside, profile[:, :, np.clip(index, 0, profile.shape[2] - 1)], 0.0))
    y, x = (term.astype(np.float32) for term in terms)  # (n, rank, pixels, nodes)
    return np.ascontiguousarray(y.swapaxes(1, 2)), np.ascontiguousarray(x.swapaxes(2, 3))
