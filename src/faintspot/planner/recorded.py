"""The question from recorded frames: layout, camera, PSF and light are measured."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.checks import finite_array
from faintspot.errors import InputError
from faintspot.estimate.noise import pixel_noise
from faintspot.planner.question import Question
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.photon_transfer import DetectorMeasurement, measure_detector
from faintspot.sensor.psf import PSF

_SPOTS_TO_LEARN_FROM = 2000


def question_from_frames(frames: ArrayLike, darks: ArrayLike | None = None, **given: Any) -> Question:
    """Return the question that recorded frames answer for the most part.

    The layout is found (`Layout.from_frame`), gain, read noise and dark level are measured
    (`faintspot.measure_detector`), the PSF is learnt (`faintspot.learn_psf`) and so is the spots' light.

    Parameters
    ----------
    frames : (n, h, w) or (h, w) array, ADU
        Of a steady light where the gain is to be measured.
    darks : (n, h, w) or (h, w) array, optional
        Frames without light.
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
    """
    stack = _stack("frames", frames)
    dark_stack = None if darks is None else _stack("darks", darks)
    if dark_stack is not None and dark_stack.shape[1:] != stack.shape[1:]:
        raise InputError(f"darks: expected frames of {stack.shape[1:]}, got {dark_stack.shape[1:]}")
    facts: list[str] = []
    layout = given.pop("layout", None)
    if layout is None:
        dark_mean = 0.0 if dark_stack is None else dark_stack.mean(axis=0)
        layout = Layout.from_frame(stack.mean(axis=0) - dark_mean, pixels=given.get("pixels"))
        ny, nx = layout.window
        facts.append(f"{len(layout)} sub-apertures of {ny} x {nx} px found in the frames")
    given.pop("pixels", None)
    calibration = _calibration(stack, dark_stack, layout, given, facts)
    images = _electrons(stack, layout, calibration)
    if given.get("flux_e") is None and given.get("magnitude") is None:
        given["flux_e"] = float(images.sum(axis=(-2, -1)).mean())
        facts.append(
            f"light measured: {given['flux_e']:.0f} electrons per sub-aperture and frame, on average"
        )
    if given.get("psf") is None and given.get("fwhm_px") is None:
        given["psf"] = _learnt(stack, layout, calibration, facts)
    values = {
        "gain_e_per_adu": calibration.gain_e_per_adu,
        "em_gain": calibration.em_gain,
        "read_noise_e": calibration.read_noise_e,
    }
    earlier = tuple(given.pop("facts", ()))
    return Question(**{**given, **values}, layout=layout, calibration=calibration, facts=(*earlier, *facts))


def _stack(name: str, value: Any) -> NDArray[Any]:
    array = finite_array(name, value, minimum_dimensions=2)
    if array.ndim > 3:
        raise InputError(f"{name}: expected (n, h, w) or (h, w), got shape {array.shape}")
    return array if array.ndim == 3 else array[None]


def _calibration(
    stack: NDArray[Any],
    darks: NDArray[Any] | None,
    layout: Layout,
    given: dict[str, Any],
    facts: list[str],
) -> Calibration:
    """Dark, gain and read noise: measured, or given."""
    em_gain = float(given.get("em_gain") or 1.0)
    found = _measured(stack, darks, layout, em_gain)
    gain = given.get("gain_e_per_adu")
    if gain is None:
        if found is None or found.gain_e_per_adu is None or not found.reliable:
            reason = (
                "a single frame is not enough"
                if found is None or found.gain_e_per_adu is None
                else found.notes[-1]
            )
            raise InputError(
                f"gain_e_per_adu: expected a value, as the frames do not tell the gain: {reason}"
            )
        gain = found.gain_e_per_adu
        facts.append(f"gain measured: {gain:.3g} +- {found.gain_e_per_adu_error:.2g} electrons per ADU")
    dark: Any = 0.0
    if darks is not None:
        dark = darks.mean(axis=0)
    elif found is not None:
        dark = found.dark_level_adu
    else:
        dark = float(np.median(layout.images(stack)[..., [0, -1], :]))
    read_noise = given.get("read_noise_e")
    if read_noise is None:
        read_noise_adu = found.read_noise_adu if found is not None else pixel_noise(layout.images(stack))
        read_noise = float(f"{read_noise_adu * gain:.3g}")
        how = (
            "from the darks"
            if darks is not None and len(darks) > 1
            else "from the darkest pixels of the frames"
        )
        facts.append(f"read noise measured {how}: {read_noise:g} electrons")
    if darks is None:
        facts.append("dark level taken from the frames' darkest pixels; --dark gives the camera's own")
    # Electrons for an ADU at the output; the multiplication is divided out by the calibration.
    return Calibration(
        dark=dark,
        gain_e_per_adu=gain,
        em_gain=em_gain,
        read_noise_e=read_noise,
        rough_dark=darks is None,
    )


def _measured(
    stack: NDArray[Any], darks: NDArray[Any] | None, layout: Layout, em_gain: float
) -> DetectorMeasurement | None:
    """What the frames tell of the camera; None where they are too few."""
    usable_darks = None if darks is None or len(darks) < 2 else darks
    if len(stack) > 1:
        return measure_detector(stack, usable_darks, layout=layout, em_gain=em_gain)
    if usable_darks is not None:
        return measure_detector(None, usable_darks, em_gain=em_gain)
    return None


def _electrons(stack: NDArray[Any], layout: Layout, calibration: Calibration) -> NDArray[np.float64]:
    dark, electrons_per_adu = layout.images(calibration.maps(layout.frame_shape))
    images: NDArray[np.float64] = (layout.images(stack) - dark) * electrons_per_adu
    return images


def _learnt(stack: NDArray[Any], layout: Layout, calibration: Calibration, facts: list[str]) -> PSF:
    """Learn the PSF from the first frames."""
    from faintspot.training.psf_learning import learn_psf

    count = max(1, _SPOTS_TO_LEARN_FROM // len(layout))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        psf = learn_psf(stack[:count], layout, calibration=calibration, rng=np.random.default_rng(1))
    width, used = float(psf.fwhm_px.mean()), min(count, len(stack)) * len(layout)
    facts.append(f"PSF learnt from {used} spots: {width:.2f} px wide, pixel included")
    facts += [str(warning.message) for warning in caught]
    return psf
