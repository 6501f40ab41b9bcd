"""Settings as version 0.1 wrote them: all options in one list, and "cog" for TV denoising or none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from faintspot.errors import InputError
from faintspot.estimators.registry import estimator_named
from faintspot.options import PerSubaperture, is_auto

_FORMER_DENOISING = "cog"


def current_options(estimator: str | None, options: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the name of an estimator and its options, from what may be those of version 0.1.

    There `denoise` decided whether "cog", the default, denoised, everywhere or in some sub-apertures.

    Raises
    ------
    InputError
        For `denoise` with an estimator that has no such choice.
    """
    rest = {name: value for name, value in options.items() if name != "denoise"}
    name = _FORMER_DENOISING if estimator is None else estimator
    if "denoise" not in options:
        return ("tv" if name == _FORMER_DENOISING else name), rest
    denoise = _flags(options["denoise"])
    if denoise is True:
        if name in (_FORMER_DENOISING, "tv"):
            return "tv", rest
        raise InputError(f'denoise = True: {name!r} does not; write estimator = "tv" and its noise_std')
    if denoise is False:
        if name in (_FORMER_DENOISING, "tv", "brightest"):
            own = estimator_named("brightest").declared()
            foreign = estimator_named("tv").declared().keys() - own.keys()
            return "brightest", {key: value for key, value in rest.items() if key not in foreign}
        return name, rest
    if name not in (_FORMER_DENOISING, "tv"):
        raise InputError(f"denoise: {name!r} has no such option for some sub-apertures")
    return "tv", {**rest, "noise_std": _strengths(rest.get("noise_std"), denoise)}


def without_foreign(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a table of version 0.1 without those that say nothing to its estimator."""
    wanted, options = current_options(
        values.get("estimator"), {name: value for name, value in values.items() if name != "estimator"}
    )
    foreign = ALL_FORMER - set(estimator_named(wanted).declared())
    return {"estimator": wanted, **{key: value for key, value in options.items() if key not in foreign}}


ALL_FORMER = frozenset(
    [
        "noise_std",
        "tolerance",
        "max_iterations",
        "keep_brightest",
        "rule",
        "algorithm",
        "preset",
        "flux_floor",
        "threshold_e",
        "smoothing_px",
        "weight_fwhm_px",
        "steps",
        "model_error",
        "weight_floor",
        "prior_std_px",
    ]
)
"""Options of estimators in version 0.1."""


def _flags(denoise: Any) -> Any:
    """True, False, or an array or PerSubaperture of both."""
    if isinstance(denoise, PerSubaperture):
        kinds = {denoise.default, *denoise.others.values()}
    else:
        kinds = set(np.atleast_1d(np.asarray(denoise, dtype=object)).tolist())
    for item in kinds:
        if not isinstance(item, bool | np.bool_):
            raise InputError(f"denoise = {item!r}: expected true or false")
    if len(kinds) == 1:
        return bool(kinds.pop())
    return denoise


def _strengths(noise_std: Any, denoise: Any) -> Any:
    """Strengths that are 0 where nothing is denoised."""
    if noise_std is None or is_auto(noise_std):
        raise InputError(
            f"noise_std = {noise_std!r}: expected numbers (electrons), 0 for sub-apertures not to denoise"
        )
    if isinstance(denoise, PerSubaperture):
        if isinstance(noise_std, np.ndarray | list | tuple):
            each = [bool(denoise[i]) for i in range(len(noise_std))]
            return np.where(each, noise_std, 0.0)
        places = denoise.others.keys() | (
            noise_std.others.keys() if isinstance(noise_std, PerSubaperture) else set()
        )

        def at(place: int) -> Any:
            own = noise_std[place] if isinstance(noise_std, PerSubaperture) else noise_std
            return own if denoise[place] else 0.0

        return PerSubaperture(at(-1), {place: at(place) for place in places})
    flags = np.asarray(denoise, bool)
    if isinstance(noise_std, PerSubaperture):
        noise_std = [noise_std[i] for i in range(len(flags))]
    return np.where(flags, noise_std, 0.0)
