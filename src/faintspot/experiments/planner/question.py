"""The camera, spot and star that a user asks about, checked, and the file that describes them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.config.options import TEXT, Options, number, setting
from faintspot.base.errors import InputError
from faintspot.base.toml_files import check_keys, checked_table, parse_file
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators.scene import PIXEL_BLUR_PX2, Scene
from faintspot.slopes.sensor.layout import GRID_KEYS, Layout
from faintspot.slopes.sensor.window_size import LARGEST_WINDOW, SMALLEST_WINDOW
from faintspot.slopes.simulate.photometry import (
    DEFAULT_BAND,
    DEFAULT_QUANTUM_EFFICIENCY,
    DEFAULT_THROUGHPUT,
    ZERO_POINTS,
    Photometry,
)
from faintspot.slopes.spots.laser_spots import LaserSpots
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX
from faintspot.slopes.spots.speckled import LARGEST_D_OVER_R0

PROFILES = tuple(FWHM_OF_SIZE_1_PX)
SPECKLED_ABOVE = 0.7
"""Side of a sub-aperture in r0 above which spots count as speckled."""
LARGEST_FLUX_E = 1e9
"""Largest flux of a spot in a frame."""
SEEING_WAVELENGTH_NM = 500.0
"""Wavelength at which r0 is given."""

_ARCSEC = math.pi / 180 / 3600
_SMALLEST_RANGE_PX = 1.0
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


_positive = {"low": 0.0, "low_open": True}
_part = {"low": 0.0, "high": 1.0, "low_open": True}


@dataclass(frozen=True, eq=False)
class Question(Options):
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
        See `faintspot.slopes.simulate.Photometry`.
    frame_rate_hz : float, optional
    search_range_px : float, optional
        Spots are within plus and minus this of the reference on each axis, and all estimators know it.
        Default: half of `fwhm_px`, at least 1 px.
    budget : str or float, optional
        Slope error R that is allowed, "0.1", "0.1px", "0.05arcsec" or "50mas": asks for the limiting
        magnitude.
    relative_flux : (n,) array, optional
        Flux of sub-apertures in units of their mean. Default: all have the same.
    recording : (n_frames, h, w) array, ADU, optional
        Frames, not used for the values here, on which promised errors are checked; needs `layout` and
        `calibration`.
    layout : Layout, optional
    whole_layout : Layout, optional
        Layout to write, where `layout` lacks sub-apertures that the recording shows no spots in. Default:
        `layout`.
    calibration : Calibration, optional
        Maps (dark, flat, bad pixels) to write beside the settings.
    facts : tuple of str
        Where the values came from, for the answer's account of what it rests on.
    flux_is_measured : bool
        Whether the flux is that of a recording, and not of a star that is asked about.

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

    read_noise_e: Any = number(
        None, 0.0, 1e6, "Read noise at the camera's output, before the EM gain.", unit="e-", group="camera"
    )
    pixels: Any = number(
        None, SMALLEST_WINDOW, LARGEST_WINDOW, "Side of a window [px].", whole=True, group="camera"
    )
    gain_e_per_adu: float = setting(
        1.0, "Electrons per ADU, unless measured in the frames.", unit="e-/ADU", group="camera", **_positive
    )
    em_gain: float = setting(1.0, "Gain of the multiplication register of an EMCCD.", low=1.0, group="camera")
    background_e: float = number(
        0.0, 0.0, 1e9, "Electrons of sky and dark current per pixel and frame.", unit="e-", group="camera"
    )
    fwhm_px: Any = setting(None, "Width (FWHM) of the optical spot.", unit="px", group="spot", **_positive)
    profile: str = setting(
        "diffraction", "Shape of the spot; diffraction is sinc^2.", choices=PROFILES, group="spot"
    )
    subaperture_m: Any = setting(
        None, "Side of a sub-aperture in the telescope's pupil.", unit="m", group="spot", **_positive
    )
    wavelength_nm: Any = setting(None, "Wavelength of the sensor.", unit="nm", group="spot", **_positive)
    pixel_scale_arcsec: Any = setting(
        None, "Side of a pixel on the sky.", unit="arcsec", group="spot", **_positive
    )
    r0_m: Any = setting(
        None,
        "Fried parameter at 500 nm: decides whether spots are speckled.",
        unit="m",
        group="spot",
        **_positive,
    )
    psf: PSF | None = None
    laser: LaserSpots | None = None
    magnitude: Any = number(
        None, -30, 40, "Magnitude; needs --subaperture-m and --frame-rate-hz.", unit="mag", group="star"
    )
    flux_e: Any = setting(
        None,
        "Flux instead: photo-electrons per sub-aperture and frame.",
        unit="e-",
        group="star",
        **_positive,
    )
    band: str = setting(DEFAULT_BAND, "Band of the magnitude.", choices=tuple(ZERO_POINTS), group="star")
    zero_point: float | None = setting(
        None,
        "Photons/s/m^2 of magnitude 0 in the band. Default: that of --band.",
        unit="photons",
        group="star",
        **_positive,
    )
    frame_rate_hz: Any = setting(None, "Frame rate.", unit="Hz", group="star", **_positive)
    throughput: float = setting(
        DEFAULT_THROUGHPUT, "Of atmosphere, telescope and optics.", group="star", **_part
    )
    quantum_efficiency: float = setting(
        DEFAULT_QUANTUM_EFFICIENCY, "Quantum efficiency.", group="star", **_part
    )
    search_range_px: Any = setting(
        None,
        "Largest slope. Default: from the frames, or FWHM / 2.",
        unit="px",
        group="tune",
        **_positive,
    )
    budget: str | None = setting(
        None,
        "Slope error allowed, such as 0.1 (px), 0.05arcsec: asks for the limiting magnitude.",
        unit="error",
        group="tune",
        kind=TEXT,
        check=lambda name, value: str(value),
    )
    relative_flux: NDArray[np.float64] | None = None
    recording: NDArray[Any] | None = None
    layout: Layout | None = None
    whole_layout: Layout | None = None
    calibration: Calibration | None = None
    facts: tuple[str, ...] = ()
    flux_is_measured: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._needed("read_noise_e", "the camera's read noise (electrons)")
        self._check_window()
        self._check_spot()
        self._check_star()
        self._put("search_range_px", self._range())
        if self.whole_layout is None:
            self._put("whole_layout", self.layout)
        if self.budget is not None:
            _ = self.budget_px

    # What follows -----------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a window."""
        if self.layout is not None:
            return self.layout.window
        return int(self.pixels), int(self.pixels)

    @property
    def size(self) -> float:
        """Size of the profile, see `faintspot.slopes.spots.shapes`."""
        return float(self.fwhm_px / FWHM_OF_SIZE_1_PX[self.profile])

    @property
    def d_over_r0(self) -> float:
        """Side of the sub-aperture over r0 at the sensor's wavelength, 0 where that makes no speckles."""
        if self.r0_m is None or self.psf is not None:
            return 0.0
        ratio = float(self.subaperture_m / (self.r0_m * (self.wavelength_nm / SEEING_WAVELENGTH_NM) ** 1.2))
        return ratio if ratio > SPECKLED_ABOVE else 0.0

    @property
    def detector(self) -> Detector:
        """The camera, for simulations; its gain does not matter, as its steps are left out."""
        return Detector(self.read_noise_e, background_e=self.background_e, em_gain=self.em_gain)

    @property
    def read_noise_photoelectrons(self) -> float:
        """Read noise divided by the multiplication gain."""
        return float(self.read_noise_e / self.em_gain)

    def scene(self, flux_e: float) -> Scene:
        """Return the settings that estimators have for spots of this flux."""
        return Scene(
            flux_e=flux_e,
            read_noise_e=self.read_noise_photoelectrons,
            window=self.shape,
            spot_fwhm_px=self.fwhm_px,
            position_range_px=self.search_range_px,
            excess_noise=self.detector.excess_noise_factor,
            background_e=self.background_e,
            d_over_r0=self.d_over_r0,
            diffraction_px=2 * self.size,
            profile=self.profile,
            learnt=self.psf is not None and self.laser is None,
        )

    @property
    def photometry(self) -> Photometry | None:
        """Relation of magnitude and electrons; None where sub-aperture or frame rate are not known."""
        if self.subaperture_m is None or self.frame_rate_hz is None:
            return None
        return Photometry(
            self.subaperture_m**2,
            1.0 / self.frame_rate_hz,
            self.band,
            self.zero_point,
            self.throughput,
            self.quantum_efficiency,
        )

    @property
    def star_flux_e(self) -> float:
        """Flux of the star, electrons per sub-aperture and frame."""
        if self.flux_e is not None:
            return float(self.flux_e)
        return float(not_none(self.photometry).electrons(self.magnitude))

    @property
    def subject(self) -> str:
        """The source of the flux, for messages: a star, or a recording that is measured."""
        return "recording" if self.flux_is_measured else "star"

    @property
    def flux_is_known(self) -> bool:
        """Whether estimators know the star's flux, because it is assumed and not that of a recording."""
        return self.relative_flux is None and (self.psf is None or self.laser is not None)

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
            raise InputError(
                "expected a slope error such as 0.1 (px), 0.05arcsec or 50mas",
                name="budget",
                value=self.budget,
            )
        if match[2] in (None, "px"):
            return value
        if self.pixel_scale_arcsec is None:
            raise InputError(
                f"in {match[2]} it needs the pixel scale; give pixel_scale_arcsec",
                name="budget",
                value=self.budget,
            )
        return value * (1e-3 if match[2] == "mas" else 1.0) / float(self.pixel_scale_arcsec)

    # Checks -----------------------------------------------------------------------------------------

    def _put(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _needed(self, name: str, meaning: str) -> Any:
        value = getattr(self, name)
        if value is None:
            raise InputError(f"expected {meaning}, got none", name=name)
        return value

    def _check_window(self) -> None:
        if self.layout is not None:
            if self.pixels is not None and self.layout.window != (self.pixels, self.pixels):
                ny, nx = self.layout.window
                raise InputError(f"the layout's windows have {ny} x {nx}", name="pixels", value=self.pixels)
            self._put("pixels", max(self.layout.window))
        self._needed("pixels", "the side of a sub-aperture (px)")
        check_not_quad_cells(self.shape)

    def _check_spot(self) -> None:
        if self.laser is not None:
            if self.psf is not None or self.r0_m is not None:
                raise InputError("laser: expected it without psf and r0_m, as it describes the spots itself")
            scale = self._needed("pixel_scale_arcsec", "the side of a pixel on the sky with a laser")
            if self.laser.at_m is None:
                raise InputError("laser.at_m: expected x and y of the sub-aperture to simulate [m]")
            psf = self.laser.psf(self.laser.star([self.laser.at_m], scale), self.shape)
            self._put("psf", PSF(psf.samples, psf.oversampling))  # one for all spots that are simulated
            self._put("fwhm_px", None)
        if self.psf is not None and self.fwhm_px is None:
            widths = self.psf.fwhm_px.mean(axis=0)
            # The PSF includes the pixel, which widens it; exact for Gaussian spots.
            self._put("fwhm_px", math.sqrt(max(float(widths.prod()) - PIXEL_BLUR_PX2, 0.01)))
        if self.fwhm_px is None:
            needed = [self.subaperture_m, self.wavelength_nm, self.pixel_scale_arcsec]
            if any(value is None for value in needed):
                raise InputError(
                    "spot: expected fwhm_px, or subaperture_m, wavelength_nm and pixel_scale_arcsec together"
                )
            width = self.wavelength_nm * 1e-9 / self.subaperture_m / (self.pixel_scale_arcsec * _ARCSEC)
            self._put("fwhm_px", width * FWHM_OF_SIZE_1_PX["diffraction"] / 2)
            self._put("profile", "diffraction")
        low, high = 0.3, float(min(self.shape))
        if not low <= self.fwhm_px <= high:
            raise InputError(
                f"expected {low:g} to {high:g} px, the side of a window; check subaperture_m, wavelength_nm "
                "and pixel_scale_arcsec, or pixels",
                name="fwhm_px",
                value=float(f"{self.fwhm_px:.4g}"),
            )
        if self.r0_m is None:
            return
        if self.subaperture_m is None or self.wavelength_nm is None:
            raise InputError("with it, expected subaperture_m and wavelength_nm as well", name="r0_m")
        ratio = self.d_over_r0
        if ratio > LARGEST_D_OVER_R0:
            raise InputError(
                f"expected sub-apertures of at most {LARGEST_D_OVER_R0:g} r0, got {ratio:.3g}",
                name="r0_m",
                value=self.r0_m,
            )
        if ratio and self.profile != "diffraction":
            raise InputError(
                f"expected 'diffraction', as spots are speckled (d / r0 = {ratio:.2g})",
                name="profile",
                value=self.profile,
            )

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

    def _range(self) -> float:
        default = default_search_range_px(self.fwhm_px)
        value = float(default if self.search_range_px is None else self.search_range_px)
        limit = min(self.shape) / 2
        if value > limit:
            expected = f"expected at most half a window, {limit:g} px"
            raise InputError(expected, name="search_range_px", value=value)
        return value


_LAYOUT, _LASER = "layout", "laser"


def read_camera(path: str | Path) -> dict[str, Any]:
    """Return the values of a camera file by the names of `faintspot.experiments.Question`.

    A table [layout.grid], as in a configuration, gives `layout`; [laser] gives `laser`.

    Raises
    ------
    InputError
        When the file cannot be read or is not TOML, or has an unknown table or key.
    """
    document = parse_file(path)
    groups = {name: declared.group for name, declared in Question.declared().items()}
    check_keys(f"{path}: ", document, [*groups.values(), _LAYOUT, _LASER], what="table")
    values: dict[str, Any] = {}
    for table, content in document.items():
        entries = checked_table(f"{path}: {table}", content)
        if table == _LAYOUT:
            values[_LAYOUT] = _layout(path, entries)
            continue
        if table == _LASER:
            values[_LASER] = LaserSpots.from_table(entries, Path(path))
            continue
        check_keys(f"{path}: {table}.", entries, [name for name in groups if groups[name] == table])
        values |= entries
    return values


def _layout(path: str | Path, content: Mapping[str, object]) -> Layout:
    check_keys(f"{path}: layout.", content, ["grid"], required=["grid"])
    grid = checked_table(f"{path}: layout.grid", content["grid"])
    check_keys(f"{path}: layout.grid.", grid, GRID_KEYS, required=("shape", "pixels"))
    return Layout.grid(**grid)
