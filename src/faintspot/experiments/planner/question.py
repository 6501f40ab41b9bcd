"""Camera, spot and star that a user asks about, checked; simulated spots with known positions."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none, spawn
from faintspot.base.errors import InputError
from faintspot.base.options import TEXT, setting
from faintspot.experiments.planner.stated import Spots, StatedCamera, StatedOptics, positive
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate.photometry import Photometry, StarLight
from faintspot.slopes.spots.laser_spots import LaserSpots
from faintspot.slopes.spots.psf import PSF

LARGEST_FLUX_E = 1e9
"""Largest flux of a spot in a frame."""
_SMALLEST_RANGE_PX = 1.0
_STAR: dict[str, Any] = {"group": "star", **positive}
_BUDGET = re.compile(r"\s*([-+0-9.eE]+)\s*(px|arcsec|mas)?\s*")


def check_not_quad_cells(window: tuple[int, int]) -> None:
    """Raise InputError for windows of two pixels on a side, in which estimators do not differ."""
    if min(window) < 3:
        raise InputError(
            f"quad cells (windows of {window[0]} x {window[1]} px) leave nothing to tune: every estimator is "
            "the difference of halves over the flux, whose settings `faintspot layout --grid` writes"
        )


def default_search_range_px(fwhm_px: float) -> float:
    """Return the search range of spots of which nothing but their width is known."""
    return max(_SMALLEST_RANGE_PX, fwhm_px / 2)


@dataclass(frozen=True, eq=False)
class Recorded:
    """Properties of recorded frames beside camera and spots."""

    frames: NDArray[Any] | None = None
    """(n_frames, h, w) ADU, not used for the values of the question, on which promised errors are checked;
    None of a single frame."""
    whole_layout: Layout | None = None
    """Layout to write, where that of the question lacks sub-apertures in which no spots were seen."""
    relative_flux: NDArray[np.float64] | None = None
    """(n,): flux of sub-apertures in units of their mean; None: all have the same."""
    flux_is_measured: bool = False
    """Whether the flux is that of the recording, and not of a star that is asked about."""
    facts: tuple[str, ...] = ()
    """Sources of the values, listed with the answer."""


@dataclass(frozen=True, eq=False)
class Question(StarLight, StatedOptics, StatedCamera):
    """Camera, spots and star; unknown optional values may be left out.

    Parameters
    ----------
    read_noise_e : float
        Standard deviation of the read noise, electrons at the camera's output (before it is divided by
        `em_gain`).
    pixels : int
        Side of a sub-aperture's window, px. Default: that of the layout.
    gain_e_per_adu, em_gain, background_e : float
        As in `faintspot.Calibration`.
    fwhm_px : float, optional
        Full width at half maximum of the optical spot, without the pixels' own blur. Default: 0.886
        lambda / d, from `subaperture_m`, `wavelength_nm` and `pixel_scale_arcsec`; or the PSF's.
    profile : {"diffraction", "gaussian"}
        Whether the spot is that of a square lenslet, sinc^2, or has no wings.
    subaperture_m, wavelength_nm, pixel_scale_arcsec : float, optional
        Side of a sub-aperture at the telescope's entrance; wavelength of the sensor; side of a pixel on the
        sky.
    r0_m : float, optional
        Fried parameter at 500 nm. With it spots may be speckled: where the sub-aperture is larger than 0.7 r0
        at the sensor's wavelength.
    psf : PSF, optional
        The spot itself, as learnt from frames; then no profile is assumed.
    laser : LaserSpots, optional
        Laser guide star instead of a profile; needs `pixel_scale_arcsec`.
    flux_e : float, optional
        Flux of the star: detected photons (photo-electrons) per sub-aperture and frame.
    magnitude : float, optional
        Instead of `flux_e`; needs `subaperture_m` and `frame_rate_hz`.
    band, zero_point, throughput, quantum_efficiency
        See `faintspot.slopes.simulate.Photometry`; by keyword.
    frame_rate_hz : float, optional
    search_range_px : float, optional
        Spots are within plus and minus this of the reference on each axis, and all estimators know it.
        Default: half of `fwhm_px`, at least 1 px.
    budget : str or float, optional
        Slope error R that is allowed, "0.1", "0.1px", "0.05arcsec" or "50mas": asks for the limiting
        magnitude.
    layout : Layout, optional
    calibration : Calibration, optional
        Maps (dark, flat, bad pixels) to write beside the settings.
    recorded : Recorded, optional
        With frames, it needs `layout` and `calibration`.

    Raises
    ------
    InputError
        For a value that is missing, out of range or contradicts another one.

    Examples
    --------
    >>> from faintspot.experiments import Question
    >>> question = Question(
    ...     read_noise_e=3.0, pixels=8, fwhm_px=1.8, subaperture_m=0.6, frame_rate_hz=150.0, magnitude=11.0
    ... )
    >>> round(question.star_flux_e)
    368
    """

    psf: PSF | None = None
    laser: LaserSpots | None = None
    flux_e: Any = setting(
        None, "Flux instead: photo-electrons per sub-aperture and frame.", unit="e-", **_STAR
    )
    frame_rate_hz: Any = setting(None, "Frame rate.", unit="Hz", **_STAR)
    search_range_px: Any = setting(
        None, "Largest slope. Default: from the frames, or FWHM / 2.", unit="px", group="tune", **positive
    )
    budget: str | None = setting(
        None,
        "Slope error allowed, such as 0.1 (px), 0.05arcsec: asks for the limiting magnitude.",
        unit="error",
        group="tune",
        kind=TEXT,
        check=lambda name, value: str(value),
    )
    layout: Layout | None = None
    calibration: Calibration | None = None
    recorded: Recorded = Recorded()

    def __post_init__(self) -> None:
        super().__post_init__()
        self._needed("read_noise_e", "the camera's read noise (electrons)")
        _ = self.spots
        self._check_star()
        if self.budget is not None:
            _ = self.budget_px

    # What follows -----------------------------------------------------------------------------------

    @cached_property
    def spots(self) -> Spots:
        """The spots, with all that follows from what is stated."""
        shape, psf = self._window(), self.psf
        if self.laser is not None:
            if psf is not None or self.r0_m is not None:
                raise InputError("laser: expected it without psf and r0_m, as it describes the spots itself")
            scale = self._needed("pixel_scale_arcsec", "the side of a pixel on the sky with a laser")
            if self.laser.at_m is None:
                raise InputError("laser.at_m: expected x and y of the sub-aperture to simulate [m]")
            learnt = self.laser.psf(self.laser.star([self.laser.at_m], scale), shape)
            psf = PSF(learnt.samples, learnt.oversampling)  # one for all spots that are simulated
        stated_px = None if self.laser is not None else self.fwhm_px
        fwhm_px, profile = self.width(psf, float(min(shape)), stated_px)
        d_over_r0 = self.d_over_r0(profile) if self.psf is None else 0.0
        reach = default_search_range_px(fwhm_px) if self.search_range_px is None else self.search_range_px
        if (limit := min(shape) / 2) < reach:
            expected = f"expected at most half a window, {limit:g} px"
            raise InputError(expected, name="search_range_px", value=reach)
        return Spots(shape, fwhm_px, profile, psf, d_over_r0, float(reach), self.recorded.relative_flux)

    def scene(self, flux_e: float) -> Scene:
        """Return the settings that estimators have for spots of this flux."""
        spots = self.spots
        return Scene(
            flux_e=flux_e,
            read_noise_e=self.read_noise_photoelectrons,
            window=spots.shape,
            spot_fwhm_px=spots.fwhm_px,
            position_range_px=spots.search_range_px,
            excess_noise=self.detector.excess_noise_factor,
            background_e=self.background_e,
            d_over_r0=spots.d_over_r0,
            diffraction_px=2 * spots.size,
            profile=spots.profile,
            learnt=self.psf is not None,
        )

    @property
    def photometry(self) -> Photometry | None:
        """Relation of magnitude and electrons; None where sub-aperture or frame rate are not known."""
        if self.subaperture_m is None or self.frame_rate_hz is None:
            return None
        return self.photometry_of(self.subaperture_m, self.frame_rate_hz)

    @property
    def star_flux_e(self) -> float:
        """Flux of the star, electrons per sub-aperture and frame."""
        if self.flux_e is not None:
            return float(self.flux_e)
        return float(not_none(self.photometry).electrons(not_none(self.magnitude)))

    @property
    def subject(self) -> str:
        """The source of the flux, for messages: a star, or a recording that is measured."""
        return "recording" if self.recorded.flux_is_measured else "star"

    @property
    def flux_is_known(self) -> bool:
        """Whether estimators know the star's flux, because it is assumed and not that of a recording."""
        return self.spots.relative_flux is None and self.psf is None

    @property
    def whole_layout(self) -> Layout | None:
        """Layout to write."""
        whole = self.recorded.whole_layout
        return self.layout if whole is None else whole

    @property
    def budget_px(self) -> float | None:
        """The error budget in px."""
        if self.budget is None:
            return None
        match = _BUDGET.fullmatch(str(self.budget))
        try:
            value = float(match[1]) if match else math.nan
        except ValueError:
            value = math.nan
        if match is None or not 0 < value < math.inf:
            expected = "expected a slope error such as 0.1 (px), 0.05arcsec or 50mas"
            raise InputError(expected, name="budget", value=self.budget)
        if match[2] in (None, "px"):
            return value
        if self.pixel_scale_arcsec is None:
            expected = f"in {match[2]} it needs the pixel scale; give pixel_scale_arcsec"
            raise InputError(expected, name="budget", value=self.budget)
        return value * (1e-3 if match[2] == "mas" else 1.0) / float(self.pixel_scale_arcsec)

    # Checks -----------------------------------------------------------------------------------------

    def _needed(self, name: str, meaning: str) -> Any:
        value = getattr(self, name)
        if value is None:
            raise InputError(f"expected {meaning}, got none", name=name)
        return value

    def _window(self) -> tuple[int, int]:
        """Return rows and columns of a window."""
        if self.layout is None:
            shape = (int(self._needed("pixels", "the side of a sub-aperture (px)")),) * 2
        else:
            shape = ny, nx = self.layout.window
            if self.pixels is not None and shape != (self.pixels, self.pixels):
                raise InputError(f"the layout's windows have {ny} x {nx}", name="pixels", value=self.pixels)
        check_not_quad_cells(shape)
        return shape

    def _check_star(self) -> None:
        if self.magnitude is not None and self.flux_e is not None:
            raise InputError("magnitude, flux_e: expected one of them, got both")
        if self.magnitude is None and self.flux_e is None:
            raise InputError(
                "star: expected its magnitude, or flux_e (detected photons per sub-aperture and frame)"
            )
        if self.magnitude is not None:
            for name, meaning in (
                ("subaperture_m", "the side of a sub-aperture (m)"),
                ("frame_rate_hz", "frames per s"),
            ):
                if getattr(self, name) is None:
                    raise InputError(f"with it, expected {name}, {meaning}, got none", name="magnitude")
        flux = self.star_flux_e
        if not 0.1 <= flux <= LARGEST_FLUX_E:
            raise InputError(
                f"{self.subject}: expected 0.1 to {LARGEST_FLUX_E:.0e} electrons per sub-aperture and frame, "
                f"got {flux:.3g}; check "
                + ("flux_e" if self.magnitude is None else "magnitude, subaperture_m and frame_rate_hz")
            )


SPOTS_PER_FRAME = 64


@dataclass(frozen=True, eq=False)
class SpotFrames:
    """Frames of one flux, and the truth."""

    frames: NDArray[Any]
    """(n_frames, rows, columns): windows on top of each other, electrons at the camera's output."""
    truth: Floats
    """(n_frames, SPOTS_PER_FRAME, 2), px."""


@dataclass(frozen=True, eq=False)
class SimulatedSpots:
    """Noiseless spots, to be exposed at any flux: the same positions and speckles at every one."""

    detector: Detector
    layout: Layout
    calibration: Calibration
    choosing: tuple[Floats, Floats]
    scoring: tuple[Floats, Floats]

    @classmethod
    def of(cls, question: Question, realisations: int, rng: np.random.Generator) -> SimulatedSpots:
        """Simulate `realisations` spots to score on, and half as many to choose on (whole frames)."""
        first, second = spawn(rng, 2)
        n_frames = max(2, -(-realisations // SPOTS_PER_FRAME))
        background = question.background_e * question.em_gain
        spots = question.spots
        return cls(
            question.detector,
            Layout.grid((SPOTS_PER_FRAME, 1), pixels=spots.shape),
            replace(question.camera, dark=background, gain_e_per_adu=1.0),
            spots.simulated(-(-n_frames // 2) * SPOTS_PER_FRAME, first),
            spots.simulated(n_frames * SPOTS_PER_FRAME, second),
        )

    def exposed(self, flux_e: float, rng: np.random.Generator) -> tuple[SpotFrames, SpotFrames]:
        """Return frames to choose on and frames to score on at a flux."""
        ny, nx = self.layout.window
        samples = []
        for (images, truth), noise in zip((self.choosing, self.scoring), spawn(rng, 2), strict=True):
            frames = self.detector.expose(flux_e * images, noise).reshape(-1, SPOTS_PER_FRAME * ny, nx)
            samples.append(SpotFrames(frames, truth.reshape(-1, SPOTS_PER_FRAME, 2)))
        return samples[0], samples[1]

    @cached_property
    def _pipelines(self) -> dict[str, SlopePipeline]:
        return {}

    def measure(self, sample: SpotFrames, method: Method) -> Slopes:
        """Measure the spots of a sample as the user's own frames would be."""
        # What knows the spot takes time to prepare, and often has the same settings at every flux.
        key = f"{method.settings} {id(method.psf)} {id(method.weights)}"
        if key not in self._pipelines:
            self._pipelines[key] = SlopePipeline(
                self.layout, method.settings, self.calibration, **method.parts
            )
        return self._pipelines[key](sample.frames)

    def measure_each(
        self, sample: SpotFrames, method: Method, name: str, values: Sequence[Any]
    ) -> list[tuple[NDArray[np.generic], NDArray[np.generic]]]:
        """Return x and y, (n_frames, SPOTS_PER_FRAME), for each value of one of a method's options.

        Where sub-apertures may have values of their own, the values share one pipeline.
        """
        if not method.estimator.declared()[name].per_subaperture:
            results = [self.measure(sample, method.with_options({name: value})) for value in values]
            return [(slopes.x, slopes.y) for slopes in results]
        count = len(values)
        layout = Layout.grid((count * SPOTS_PER_FRAME, 1), pixels=self.layout.window)
        settings = method.settings.replace(**{name: np.repeat(values, SPOTS_PER_FRAME)})
        pipeline = SlopePipeline(layout, settings, self.calibration, **method.parts)
        slopes = pipeline(np.tile(sample.frames, (1, count, 1)))
        x, y = (part.reshape(-1, count, SPOTS_PER_FRAME).swapaxes(0, 1) for part in (slopes.x, slopes.y))
        return list(zip(x, y, strict=True))
