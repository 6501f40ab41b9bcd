"""The question from recorded frames: layout, camera, PSF, flux and the spots' range are measured."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, finite_array, not_none
from faintspot.base.errors import InputError
from faintspot.experiments.planner.promise import frames_to_check, images_e
from faintspot.experiments.planner.question import (
    LARGEST_FLUX_E,
    Question,
    Recorded,
    check_not_quad_cells,
    default_search_range_px,
)
from faintspot.experiments.planner.stated import CAMERA
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.frame_checks import are_repeated
from faintspot.slopes.camera.photon_transfer import DetectorMeasurement, measure_detector
from faintspot.slopes.estimators.noise import pixel_noise
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX
from faintspot.slopes.training.centroid_gain import Images, SpotRange, spot_range
from faintspot.slopes.training.psf_rounds import usable_subapertures

if TYPE_CHECKING:
    from faintspot.slopes.training.psf_learning import LearntPSF
    from faintspot.slopes.training.spot_transfer import SpotTransfer


_SPOTS_TO_LEARN_FROM = 2000
_RANGE_MARGIN = 1.15
_NOISE_AMONG_SPOTS = 0.95  # of the fitted flux, below which fits have taken noise for spots
_SURELY = 3.0  # standard errors
_LEAST_VARIANCE = 0.01  # of a pixel, electrons squared
_DARK_PIXELS = 1 << 24  # that the read noise is measured in
_FEWEST_FOR_FLUX = 4  # images of each sub-aperture that tell its flux


def question_from_frames(frames: ArrayLike, darks: ArrayLike | None = None, **stated: Any) -> Question:
    """Return the question that recorded frames answer for the most part.

    The layout is found (`Layout.from_frame`), gain, read noise and dark level are measured
    (`faintspot.measure_detector`; about fitted spots, where these move too much for it). The PSF is learnt
    (`faintspot.learn_psf`) from every second frame, and fitted to its spots together with the background that
    all share: this tells their flux, how it differs between sub-apertures, and how far the spots move. The
    other frames are kept to check on them what is promised (`faintspot.experiments.check_promises`).

    Parameters
    ----------
    frames : (n, h, w) or (h, w) array, ADU
        Consecutive ones where the gain is to be measured.
    darks : (n, h, w) or (h, w) array, optional
        Frames without flux.
    **given
        What is known, as for `Question`: used instead of what would be measured. With `fwhm_px` no PSF is
        learnt.

    Returns
    -------
    Question

    Raises
    ------
    InputError
        When something can neither be measured nor is given, and as `Question`.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.experiments import question_from_frames
    >>> camera = fs.slopes.simulate.Detector(read_noise_e=3.0, gain_e_per_adu=0.5, offset_adu=100.0)
    >>> layout = fs.Layout.grid((6, 6), pixels=12)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 40, flux_e=300.0, position_range_px=0.5,
    ...     detector=camera, rng=np.random.default_rng(1),
    ... )
    >>> question = question_from_frames(frames, layout=layout)
    >>> print(f"{question.star_flux_e:.0f} e-, read noise {question.read_noise_e:.1f} e-")
    294 e-, read noise 2.9 e-
    """
    stack = _stack("frames", frames)
    dark_stack = None if darks is None else _stack("darks", darks)
    if dark_stack is not None and dark_stack.shape[1:] != stack.shape[1:]:
        raise InputError(f"darks: expected frames of {stack.shape[1:]}, got {dark_stack.shape[1:]}")
    facts: list[str] = []
    stated = {name: value for name, value in stated.items() if value is not None}
    layout = stated.pop("layout", None)
    if layout is None:
        dark_mean = 0.0 if dark_stack is None else dark_stack.mean(axis=0)
        layout = Layout.from_frame(stack.mean(axis=0) - dark_mean, pixels=stated.get("pixels"))
        ny, nx = layout.window
        facts.append(f"{len(layout)} sub-apertures of {ny} x {nx} px found in the frames")
    check_not_quad_cells(layout.window)
    stated.pop("pixels", None)
    _check_stated(layout, stated)
    stack = stack[: 2 * frames_to_check(layout)]  # every second one; more cost memory and tell nothing
    if (repeated := are_repeated(stack, None)).any():
        facts.append(
            f"{np.count_nonzero(repeated)} of {len(stack)} frames left out, repeated by the recorder"
        )
        stack = stack[~repeated]
    calibration = _calibration(stack, dark_stack, layout, stated, facts)
    stated["em_gain"] = calibration.em_gain
    whole, (usable, left_out) = layout, usable_subapertures(stack, layout, calibration)
    if left_out:
        layout = whole[usable]
        facts.append(left_out)
    learning, recording = (stack[0::2], stack[1::2]) if len(stack) > 1 else (stack, None)
    fitted, used = _fitted(learning, layout, calibration, stated, facts)
    calibration = _without_background(calibration, fitted, darks is not None, stated, facts)
    flux_is_measured = stated.get("flux_e") is None and stated.get("magnitude") is None
    if flux_is_measured:
        stated["flux_e"] = float(fitted.flux_e.mean())
        sums = float(images_e(used, layout, calibration).sum(axis=(-2, -1)).mean())
        facts.append(
            f"light measured by fitting spots and background: {stated['flux_e']:.0f} electrons per "
            f"sub-aperture and frame, on average (pixels above the background add up to {sums:.0f})"
        )
    relative = _relative_flux(fitted, len(layout), facts)
    stated |= {name: getattr(calibration, name) for name in CAMERA}
    recorded = Recorded(recording, whole, relative, flux_is_measured, tuple(facts))
    return Question(**stated, layout=layout, calibration=calibration, recorded=recorded)


def _check_stated(layout: Layout, stated: Mapping[str, object]) -> None:
    """Refuse wrong values before anything is measured: those not stated are assumed for it."""
    assumed: dict[str, Any] = {"read_noise_e": 1.0, "layout": layout}
    if stated.get("psf") is None and stated.get("laser") is None:
        assumed["fwhm_px"] = 1.0
    if stated.get("magnitude") is None:
        assumed["flux_e"] = 100.0
    Question(**{**assumed, **stated})


def _check_flux(stack: NDArray[np.generic], dark: object, layout: Layout, gain: float) -> None:
    """Refuse spots so bright that photon noise plays no part."""
    flux_e = gain * float(np.median(layout.images(stack.mean(axis=0) - dark).sum(axis=(-2, -1))))
    if flux_e > LARGEST_FLUX_E:
        raise InputError(
            f"recording: its spots have {flux_e:.2g} electrons at {gain:.3g} electrons per ADU, expected at "
            f"most {LARGEST_FLUX_E:.0e}; if the gain is another one, give gain_e_per_adu"
        )


def _stack(name: str, value: object) -> NDArray[np.generic]:
    array = finite_array(name, value, minimum_dimensions=2)
    check_shape(name, array, ("n", "h", "w"), ("h", "w"))
    return array if array.ndim == 3 else array[None]


def _calibration(
    stack: NDArray[Any], darks: NDArray[Any] | None, layout: Layout, stated: dict[str, Any], facts: list[str]
) -> Calibration:
    """Dark, gain and read noise: measured, or given."""
    em_gain = float(stated.get("em_gain") or 1.0)
    usable_darks = darks if darks is not None and len(darks) > 1 else None
    measured = _measured(stack, usable_darks, layout, em_gain)
    gain, read_noise = stated.get("gain_e_per_adu"), stated.get("read_noise_e")
    dark: object = float(np.median(layout.images(stack)[..., [0, -1], :]))
    if darks is not None:
        dark = darks.mean(axis=0)
    elif measured is not None:
        dark = measured.dark_level_adu.value
    read_noise_adu = pixel_noise(layout.images(stack)) if measured is None else measured.read_noise_adu.value
    how = "from the darkest pixels of the frames" if usable_darks is None else "from the darks"
    if gain is None:
        if measured is None or np.isnan(measured.gain_e_per_adu.value):
            raise InputError(
                "gain_e_per_adu: expected a value, as the frames do not tell the gain: a single frame is not "
                "enough"
            )
        gain, error = measured.gain_e_per_adu.value, measured.gain_e_per_adu.standard_error
        way = "from frame to frame"
        about_spots = _measured_on_spots(stack, dark, layout, em_gain)
        if isinstance(about_spots, str):
            if not measured.reliable:
                raise InputError(
                    "gain_e_per_adu: expected a value, as the frames do not tell the gain: "
                    f"{measured.notes[-1]}; about fitted spots: {about_spots}"
                )
        else:  # where it is possible, it is the better one: movement and faint flux do not bias it
            gain, error = about_spots.gain_e_per_adu, about_spots.gain_e_per_adu_error
            way = "about fitted spots, wherever they move"
            if usable_darks is None:
                read_noise_adu, how = about_spots.read_noise_adu, "in the pixels about the fitted spots"
        facts.append(f"gain measured {way}: {gain:.3g} +- {error:.2g} electrons per ADU")
    _check_flux(stack, dark, layout, gain / em_gain)
    if read_noise is None:
        read_noise = float(f"{read_noise_adu * gain:.3g}")
        facts.append(f"read noise measured {how}: {read_noise:g} electrons")
    background = float(stated.get("background_e") or 0.0)
    # Electrons for an ADU at the output; the multiplication is divided out by the calibration.
    return Calibration(
        dark=dark,
        gain_e_per_adu=gain,
        em_gain=em_gain,
        read_noise_e=read_noise,
        background_e=background,
        estimated=("dark",) if darks is None else (),
    )


def _measured(
    stack: NDArray[np.generic], darks: NDArray[np.generic] | None, layout: Layout, em_gain: float
) -> DetectorMeasurement | None:
    """Camera properties measured in the frames; None where they are too few."""
    if darks is not None:
        darks = darks[: max(2, _DARK_PIXELS // darks[0].size)]
    if len(stack) > 1:
        return measure_detector(stack, darks, layout=layout, em_gain=em_gain)
    return None if darks is None else measure_detector(None, darks, em_gain=em_gain)


def _measured_on_spots(stack: NDArray[Any], dark: Any, layout: Layout, em_gain: float) -> SpotTransfer | str:
    """Camera properties from the noise about fitted spots, or the reason why there are none."""
    from faintspot.slopes.training.spot_transfer import measure_on_spots

    sample = _some(stack, layout)
    images = layout.images(sample) - layout.images(np.broadcast_to(dark, stack.shape[1:]))
    try:
        images = images.reshape(-1, *layout.window)
        measured = measure_on_spots(images, em_gain=em_gain, rng=np.random.default_rng(1))
    except InputError as error:
        return str(error)
    return measured if measured.problem is None else measured.problem


def _some(frames: NDArray[np.generic], layout: Layout) -> NDArray[Any]:
    """Frames from all of a recording, as many as hold enough spots."""
    count = min(len(frames), max(1, _SPOTS_TO_LEARN_FROM // len(layout)))
    sample: NDArray[np.generic] = frames[np.linspace(0, len(frames) - 1, count).round().astype(int)]
    return sample


def _fitted(
    frames: NDArray[Any], layout: Layout, calibration: Calibration, stated: dict[str, Any], facts: list[str]
) -> tuple[LearntPSF, NDArray[Any]]:
    """Fit spots and background in some of the frames, returned as well; learn PSF and range if need be."""
    used = _some(frames, layout)
    images = images_e(used, layout, calibration).reshape(-1, *layout.window)
    plain = replace(calibration, dark=0.0, gain_e_per_adu=1.0, em_gain=1.0)
    plain = replace(plain, read_noise_e=calibration.read_noise_photoelectrons)
    assumed, reach = _assumed_psf(layout, stated), stated.get("search_range_px")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fitted = _fit(images, plain, assumed, layout, reach)
        if reach is None:
            measured = _range(images, plain, fitted, layout)
            reach = stated["search_range_px"] = _range_to_use(measured, fitted.psf, layout, facts)
            if measured.flux_scale < _NOISE_AMONG_SPOTS:
                del caught[:]
                fitted = _fit(images, plain, assumed, layout, reach)
    if stated.get("fwhm_px") is None and stated.get("psf") is None:
        stated["psf"] = fitted.psf
        width = float(fitted.psf.fwhm_px.mean())
        facts.append(f"PSF learnt from {len(images)} spots: {width:.2f} px wide, pixel included")
        facts += [str(warning.message) for warning in caught]
    return fitted, used


def _assumed_psf(layout: Layout, stated: dict[str, Any]) -> PSF | None:
    """Return the PSF where it is given or its width is."""
    if stated.get("psf") is not None or stated.get("fwhm_px") is None:
        psf: PSF | None = stated.get("psf")
        return psf
    profile = stated.get("profile") or "diffraction"
    size = stated["fwhm_px"] / FWHM_OF_SIZE_1_PX[profile]
    return PSF.analytic(profile, size=size, radius_px=max(layout.window))


def _fit(
    images: NDArray[Any], calibration: Calibration, psf: PSF | None, layout: Layout, reach: float | None
) -> LearntPSF:
    """Fit spots and background within a range of the references; learn the PSF where there is none."""
    from faintspot.slopes.training.psf_learning import fit_spots, learn_psf_from_images

    search = None if reach is None else reach + float(np.abs(layout.offsets).max())
    if psf is not None:
        return fit_spots(images, psf, calibration=calibration, search_range_px=search)
    rng = np.random.default_rng(1)
    return learn_psf_from_images(images, calibration=calibration, search_range_px=search, rng=rng)


def _range(images: NDArray[Any], calibration: Calibration, fitted: LearntPSF, layout: Layout) -> SpotRange:
    """Measure how far spots are from their references."""
    n, background = len(layout), float(fitted.background_e[0])
    fluxes = fitted.flux_e.reshape(-1, n)
    relative = _relative_flux(fitted, n, [])
    flux = fluxes.mean() * (np.ones(n) if relative is None else relative)
    noise = not_none(calibration.read_noise_photoelectrons)
    excess = calibration.excess_noise
    dark = noise**2 + excess * max(background, calibration.background_e, 0.0)
    repeated = np.tile(layout.offsets, (len(fluxes), 1)), np.tile(flux, len(fluxes))
    return spot_range(Images(images - background, *repeated, max(dark, _LEAST_VARIANCE), excess), fitted.psf)


def _range_to_use(measured: SpotRange, psf: PSF, layout: Layout, facts: list[str]) -> float:
    """Return the measured range with a margin, or the default where the flux does not tell it."""
    limit = min(layout.window) / 2
    if measured.is_measured:
        facts.append(
            f"search range: 99 % of the spots are within {measured.quantile_px:.2f} px of the reference on "
            "each axis, noise accounted for"
        )
        return min(max(1.0, float(f"{_RANGE_MARGIN * measured.quantile_px:.3g}")), limit)
    default = min(float(f"{default_search_range_px(float(psf.fwhm_px.mean())):.3g}"), limit)
    facts.append(
        "search range: the flux is too low to measure how far spots are from their references; the default, "
        f"±{default:g} px, is assumed (--search-range-px gives another)"
    )
    return default


def _without_background(
    calibration: Calibration, fitted: LearntPSF, has_darks: bool, stated: dict[str, object], facts: list[str]
) -> Calibration:
    """Take the fitted background off with the dark; above the camera's own, it is light with noise."""
    background = float(fitted.background_e[0])
    adu = background * calibration.em_gain / calibration.gain_e_per_adu
    calibration = replace(calibration, dark=calibration.dark + adu)
    if not has_darks:
        facts.append(
            f"dark level fitted with the spots: {float(calibration.dark):.4g} ADU; --dark tells sky and "
            "camera apart"
        )
        return calibration
    facts.append(f"background fitted with the spots: {background:.2g} electrons per pixel above the darks")
    if stated.get("background_e") is None:
        calibration = replace(calibration, background_e=float(f"{max(background, 0.0):.3g}"))
    return calibration


def _relative_flux(fitted: LearntPSF, n: int, facts: list[str]) -> NDArray[np.float64] | None:
    """Flux of every sub-aperture over the mean, where there are images enough to tell it from noise."""
    fluxes = fitted.flux_e.reshape(-1, n)
    if len(fluxes) < _FEWEST_FOR_FLUX or fluxes.mean() <= 0:
        return None
    flux: NDArray[np.float64] = np.maximum(fluxes.mean(axis=0), 0.0) / fluxes.mean()
    scatter = float(np.sqrt(np.mean(fluxes.var(axis=0, ddof=1)) / len(fluxes)) / fluxes.mean())
    if flux.std() < _SURELY * scatter:
        return None
    low, high = np.quantile(flux, [0.05, 0.95])
    facts.append(f"flux of the sub-apertures: {low:.2f} to {high:.2f} times the mean in nine of ten")
    flux /= flux.mean()
    return flux
