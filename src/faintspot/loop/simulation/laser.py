"""Sensor of a laser guide star, the low orders from a natural star, and knowledge of the sodium layer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.loop.control.options import TIP_TILT, RemovedModes
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import FILTER, FOLLOWED, Method
from faintspot.loop.simulation.wavefront_sensor import ImageAxis, ShackHartmann
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import FWHM_TO_STD
from faintspot.slopes.spots.sodium import SodiumProfile
from faintspot.slopes.training.sodium import KnownSodium, MeanImages

Floats = NDArray[np.float64]

Images = NDArray[np.float32]

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
    """Lenslets that see a laser guide star; its axes lead to fine nodes of an image.

    The image of a point at the focus is taken on nodes within its unaliased field, and convolved with the
    image of the sodium layer, which has the beam's width and is integrated over the pixels.
    """

    along_y: Images
    """(n, pixels * rank, nodes): from nodes to rows, for each separable term."""
    along_x: Images
    """(n, rank * nodes, pixels)"""

    def spots(self, wavefront_nm: NDArray[np.floating], displacement_px: float = 0.0) -> Images:
        """See `ShackHartmann.spots`."""
        fine = super().spots(wavefront_nm, displacement_px)
        n, pixels = len(fine), self.along_x.shape[-1]
        rows = np.matmul(self.along_y, fine).reshape(n, pixels, -1)
        images: Images = np.matmul(rows, self.along_x)
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
    axis = ImageAxis(transform, weights)
    return replace(sensor, image_y=axis, image_x=axis)


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


_OF_NOISE = 6  # of a frame's random numbers


class LowOrders:
    """Slopes of a laser guide star with tip and tilt, and slowly focus, from a natural star.

    The natural star's sensor has four sub-apertures, the quadrants of the pupil. Tip and tilt are the mean of
    its slopes, and replace those of the laser's slopes, each time that `tip_tilt_frames` have been averaged;
    between, they are 0. Its focus moves the reference of the laser's focus by a fraction every
    `focus_frames`.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser; without a natural star, tip and tilt are only removed.
    sensor : ShackHartmann
    seed, realisation : int
    """

    def __init__(
        self, configuration: LoopConfiguration, sensor: ShackHartmann, seed: int, realisation: int
    ) -> None:
        self._star, self._sensor = configuration.natural_star, sensor
        self._seed = seed, realisation
        self._tip_tilt = RemovedModes(TIP_TILT)
        centres_m = subaperture_centres_m(configuration, sensor.layout.cells)
        sides = centres_m > 0
        self._quadrant = sides[:, 0] + 2 * sides[:, 1]
        self._focus = centres_m.T.ravel()
        self._of_quadrants = self._means(self._focus)
        self._tilts = np.zeros(2)
        self._curved, self._offset = 0.0, 0.0
        if self._star is not None:
            pixel = configuration.pixel_scale_rad / ARCSEC
            quadrant_e = 0.25 * self._star.photons
            self._noise_px = self._star.fwhm_arcsec * FWHM_TO_STD / pixel / math.sqrt(quadrant_e)

    def merged(
        self, frame: int, wavefront_nm: NDArray[np.floating], slopes_px: Floats, flags: NDArray[np.uint8]
    ) -> Floats:
        """Return slopes (2 n,) of the laser with the low orders of the natural star.

        Parameters
        ----------
        frame : int
            Number of the frame, which seeds the noise.
        wavefront_nm : (points, points) array
            Wavefront that both sensors see.
        slopes_px : (2 n,) array
            Slopes of the laser guide star in true px.
        flags : (n,) array
            As in `faintspot.Slopes`.
        """
        merged = self._tip_tilt.removed(slopes_px, flags)
        if self._star is None:
            return merged
        rng = np.random.default_rng([*self._seed, frame, _OF_NOISE])
        means = self._means(self._sensor.mean_slopes_px(wavefront_nm))
        means = means + rng.normal(0.0, self._noise_px, means.shape)
        self._tilts += means.mean(axis=1)
        centred = self._of_quadrants - self._of_quadrants.mean(axis=1, keepdims=True)
        self._curved += float((centred * means).sum() / np.square(centred).sum())
        if (frame + 1) % self._star.focus_frames == 0:
            self._offset += self._star.focus_gain * self._curved / self._star.focus_frames
            self._curved = 0.0
        merged = merged + self._offset * self._focus
        if (frame + 1) % self._star.tip_tilt_frames == 0:
            merged = merged + np.repeat(self._tilts / self._star.tip_tilt_frames, len(flags))
            self._tilts = np.zeros(2)
        return merged

    def _means(self, slopes_px: Floats) -> Floats:
        """Return mean slopes of the quadrants, (2, 4)."""
        counts = np.bincount(self._quadrant, minlength=4)
        sums = [np.bincount(self._quadrant, slopes, 4) for slopes in slopes_px.reshape(2, -1)]
        return np.asarray(np.stack(sums) / np.maximum(counts, 1))


_ALTITUDES = 41  # of the profile that is fitted
_FIRST_FWHM = 0.35  # of the range of altitudes: single layer from which the fit begins
_OF_LEARNING = 8  # random numbers


def with_spots(sodium: KnownSodium, configuration: LoopConfiguration, method: Method) -> Method:
    """Return a method that knows the spots."""
    pixels = configuration.sensor.pixels
    psf, scene = sodium.psf((pixels, pixels)), configuration.scene
    if FILTER not in method.variants:
        return replace(method, psf=psf)
    weights = FixedWeights.matched(
        psf,
        (pixels, pixels),
        flux_e=np.maximum(sodium.fit.flux_e, 1.0),
        read_noise_e=scene.read_noise_e,
        excess_noise=scene.excess_noise,
        background_e=scene.background_e,
    )
    return replace(method, psf=psf, score=weights)


def learn_sodium(
    configuration: LoopConfiguration, layout: Layout, spots: NDArray[np.float32], seed: int
) -> KnownSodium:
    """Return what the mean of `laser.learn_frames` frames shows, beginning with a single layer.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    layout : Layout
    spots : (wavefronts, n, pixels, pixels) array
        Images of unit flux before the run.
    seed : int
        Of the noise of the mean.
    """
    laser, scene = not_none(configuration.laser), configuration.scene
    dark = scene.dark_noise_e**2
    mean_e = configuration.photons * spots.mean(axis=0, dtype=np.float64)
    rng = np.random.default_rng([seed, _OF_LEARNING])
    noise = np.sqrt((scene.excess_noise * mean_e + dark) / laser.learn_frames)
    images = mean_e + noise * rng.standard_normal(mean_e.shape)
    mean = MeanImages(images, np.zeros((len(layout), 2)), frames=laser.learn_frames)
    low, high = laser.altitude_m[0], laser.altitude_m[-1]
    star = laser_guide_star(configuration, layout.cells, laser.spot_fwhm_arcsec)
    layer = SodiumProfile.gaussian(laser.focus_altitude_m, _FIRST_FWHM * (high - low))
    start = star.focused(layer).at(np.linspace(low, high, _ALTITUDES))
    return KnownSodium.learnt(mean, star, start, dark)


class FollowedSodium:
    """Sodium profile of a method that follows it, from the running mean of its own frames.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    layout : Layout
    known : KnownSodium
        Known before the run.
    """

    def __init__(self, configuration: LoopConfiguration, layout: Layout, sodium: KnownSodium) -> None:
        self._laser, self._layout = not_none(configuration.laser), layout
        camera = configuration.camera
        background = camera.background_e + camera.dark_e
        self._scale = camera.gain_e_per_adu / camera.em_gain
        self._dark_adu = camera.offset_adu + background / self._scale
        self._mean: MeanImages | None = None
        self._frames = 0
        self.sodium = sodium

    def take(self, frame_adu: NDArray[np.generic], slopes_px: Floats) -> bool:
        """Take a frame and its slopes (2 n,) from the window centres; return whether the profile is new."""
        images = self._layout.images((frame_adu.astype(np.float64) - self._dark_adu) * self._scale)
        positions = slopes_px.reshape(2, -1).T
        if self._mean is None:
            self._mean = MeanImages(images, positions, self._laser.follow_time_constant_frames)
        else:
            self._mean = self._mean.updated(images, positions)
        self._frames += 1
        if self._frames % self._laser.follow_every_frames:
            return False
        self.sodium = self.sodium.updated(self._mean)
        return True


class LaserRun:
    """Part of a run that only a laser guide star needs: known and followed spots, and low orders.

    Parameters
    ----------
    configuration : LoopConfiguration
        With a laser.
    layout : Layout
    methods : sequence of Method
    known : KnownSodium
        Known before the run.
    low_orders : LowOrders

    Attributes
    ----------
    methods : list of Method
        They know the spots, as they were before the run or as followed since.
    """

    def __init__(
        self,
        configuration: LoopConfiguration,
        layout: Layout,
        methods: Sequence[Method],
        known: KnownSodium,
        low_orders: LowOrders,
    ) -> None:
        self._configuration, self.low_orders = configuration, low_orders
        self.methods = [
            with_spots(known, configuration, method) if method.psf is None else method for method in methods
        ]
        self._followed = {
            number: FollowedSodium(configuration, layout, known)
            for number, method in enumerate(methods)
            if FOLLOWED in method.variants
        }

    def follow(self, number: int, frame_adu: NDArray[np.generic], slopes_px: Floats) -> bool:
        """Take a frame of a method for its sodium profile; return whether the method has new spots."""
        followed = self._followed.get(number)
        if followed is None or not followed.take(frame_adu, slopes_px):
            return False
        self.methods[number] = with_spots(followed.sodium, self._configuration, self.methods[number])
        return True
