"""Settings: how each sub-aperture's image is turned into a position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from dataclasses import replace as dataclass_replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import number_between, numbers_between, one_of
from faintspot.errors import InputError
from faintspot.presets import PRESETS, of_denoising

ALGORITHMS = ("fgp", "chambolle")
RULES = ("subtract_next", "threshold", "subtract_kth")
ESTIMATORS = ("cog", "thresholded", "smoothed", "weighted", "matched", "ml", "map", "trained")
AUTO = "auto"
KEPT_FRACTION = 0.08  # of a window's pixels, where keep_brightest is not given: 20 of 16 x 16
FEWEST_KEPT = 5

PER_SUBAPERTURE = (
    "noise_std",
    "tolerance",
    "max_iterations",
    "keep_brightest",
    "rule",
    "denoise",
    "flux_floor",
    "max_bad_fraction",
    "threshold_e",
    "smoothing_px",
    "spot_fwhm_px",
    "spot_fwhm_y_px",
    "weight_fwhm_px",
    "model_error",
    "weight_floor",
    "search_range_px",
    "flux_e",
    "prior_std_px",
    "error_scale",
)
_OPTIONAL = (
    "noise_std",
    "tolerance",
    "max_iterations",
    "keep_brightest",
    "threshold_e",
    "smoothing_px",
    "spot_fwhm_px",
    "spot_fwhm_y_px",
    "weight_fwhm_px",
    "search_range_px",
    "flux_e",
    "prior_std_px",
)
"""Settings that may be none: not needed, or found by themselves."""

# Bounds of the numbers, and whether the lower one is refused itself.
_BOUNDS = {
    "max_iterations": (1, 2**24, False),
    "keep_brightest": (1, 2**24, False),
    "tolerance": (0.0, 1.0, False),
    "noise_std": (0.0, math.inf, False),
    "flux_floor": (0.0, 1.0, False),
    "max_bad_fraction": (0.0, 1.0, False),
    "threshold_e": (0.0, 1e12, False),
    "smoothing_px": (0.0, 16.0, True),
    "spot_fwhm_px": (0.1, 64.0, False),
    "spot_fwhm_y_px": (0.1, 64.0, False),
    "weight_fwhm_px": (0.1, 64.0, False),
    "model_error": (0.0, 10.0, False),
    "weight_floor": (0.0, 1.0, False),
    "search_range_px": (0.0, 1e4, True),
    "flux_e": (0.0, 1e12, True),
    "prior_std_px": (0.0, 1e4, True),
    "error_scale": (0.0, 1e3, True),
}
_WHOLE = ("max_iterations", "keep_brightest")


@dataclass(frozen=True)
class PerSubaperture:
    """A value for every sub-aperture of a sensor of any size: one default, and others in some places."""

    default: Any
    others: Mapping[int, Any]

    def __getitem__(self, index: int) -> Any:
        """Value of sub-aperture `index`."""
        return self.others.get(int(index), self.default)


@dataclass(frozen=True)
class Settings:
    """How each sub-aperture's image is turned into a position; immutable.

    Every value but `estimator`, `algorithm`, `preset` and `steps` is a scalar or holds one value per
    sub-aperture.

    Parameters
    ----------
    noise_std : float or array, electrons, or "auto"
        Strength of the denoising: the standard deviation of the noise to remove from a pixel. "auto": from
        read noise, light and spot, by `faintspot.estimate.automatic.automatic_strength`. Needed by the
        estimator "cog" where `denoise` is true.
    tolerance : float or array, optional
        Relative change at which the denoising of a sub-aperture stops; see `faintspot.tv_denoise`. Default:
        that of the preset, 0.01 or, with "fast", 0: only the limit stops it.
    max_iterations : int or array, optional
        Its iteration limit. Default: that of the preset, 200 or 8.
    keep_brightest : int or array or "auto", optional
        Number of pixels that the background subtraction keeps. Default: 8 % of the window's pixels, at
        least 5. "auto": by `faintspot.estimate.automatic.automatic_kept_pixels`.
    rule : str or array of str
        "subtract_next" | "threshold" | "subtract_kth"; see `faintspot.brightest_pixels`.
    denoise : bool or array of bool
        Whether to denoise at all.
    algorithm : str
        "fgp" | "chambolle".
    preset : str
        "accurate" | "fast". "fast" does little work, and the same for every image: the denoising begins at
        the dual field of a flat solution and makes 8 iterations, see `faintspot.tv_denoise`; "map" and
        "weighted" make fewer steps. What else is given here goes before it. docs/fast.md says what it costs.
    flux_floor : float or array
        A sub-aperture is flagged NO_LIGHT when the flux that is left after the background subtraction is not
        above this fraction of its image's largest pixel.
    max_bad_fraction : float or array
        A sub-aperture with a larger fraction of bad pixels is invalid.
    estimator : str
        How a position is found, see `faintspot.estimators`: "cog" (TV denoising where `denoise` is true,
        brightest pixels, centre of gravity), "smoothed" (linear smoothing instead of TV), "thresholded",
        "weighted", "matched", "ml", "map", "trained".
    threshold_e : float or array, electrons
        What "thresholded" takes off every pixel; what is negative then becomes 0.
    smoothing_px : float or array
        Standard deviation of the Gaussian of "smoothed". Default 0.7.
    spot_fwhm_px, spot_fwhm_y_px : float or array
        Full width at half maximum of the spots in the frame, along x and y (default: the same). Default: that
        of the PSF.
    weight_fwhm_px : float or array
        Full width at half maximum of the weight of "weighted", geometric mean of both axes; it is elongated
        like the spot. Default: that of the spot.
    steps : int
        Of "ml" and "matched" (default 3), "map" (3; "fast": 2) or "weighted" (8; "fast": 3).
    model_error : float or array
        How far the spots differ from the PSF, as a fraction of each pixel's light: "ml" and "map" trust
        bright pixels no more than that. 0.1 to 0.5 for speckled spots.
    weight_floor : float or array
        Variance, as a fraction of the light, that is added to every pixel's weight, so that small errors
        of the PSF in dark wings carry no large weights.
    search_range_px : float or array
        Largest slope: positions are sought, and kept, within so much of the reference. Default: the
        whole window.
    flux_e : float or array, electrons
        Light expected of a spot in a frame; "map", "trained" and "auto" use it. Default: measured in each
        frame, as the mean of all sub-apertures.
    prior_std_px : float or array
        Standard deviation of the prior of "map". Default: none but the search range.
    error_scale : float or array
        Factor on the standard errors.

    Raises
    ------
    InputError
        For a value out of range, NaN, of the wrong kind, or arrays of different lengths.
    """

    noise_std: Any = None
    tolerance: Any = None
    max_iterations: Any = None
    keep_brightest: Any = None
    rule: Any = "subtract_next"
    denoise: Any = True
    algorithm: str = "fgp"
    preset: str = "accurate"
    flux_floor: Any = 1e-4
    max_bad_fraction: Any = 0.25
    estimator: str = "cog"
    threshold_e: Any = None
    smoothing_px: Any = None
    spot_fwhm_px: Any = None
    spot_fwhm_y_px: Any = None
    weight_fwhm_px: Any = None
    steps: int | None = None
    model_error: Any = 0.0
    weight_floor: Any = 2e-4
    search_range_px: Any = None
    flux_e: Any = None
    prior_std_px: Any = None
    error_scale: Any = 1.0

    def __post_init__(self) -> None:
        one_of("algorithm", self.algorithm, ALGORITHMS)
        one_of("preset", self.preset, PRESETS)
        one_of("estimator", self.estimator, ESTIMATORS)
        if self.steps is not None:
            object.__setattr__(self, "steps", int(number_between("steps", self.steps, 1, 100, integer=True)))
        for name in PER_SUBAPERTURE:
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        lengths = {name: len(value) for name in PER_SUBAPERTURE if _is_array(value := getattr(self, name))}
        if len(set(lengths.values())) > 1:
            sizes = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise InputError(f"settings: expected arrays of one length, got {sizes}")
        if self.estimator == "cog" and _lacks_strength(self.noise_std, self.denoise):
            raise InputError(
                'noise_std: expected a number (electrons) or "auto", got none; or set denoise = false'
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Settings):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__ = None  # type: ignore[assignment]

    @classmethod
    def load(cls, path: str | Path) -> Settings:
        """Read the table [settings] of a configuration file (TOML)."""
        from faintspot.sensor import configuration

        return configuration.load(path, "settings")  # type: ignore[no-any-return]

    def save(self, path: str | Path) -> None:
        """Write the table [settings] of a configuration file (TOML); other tables stay as they are."""
        from faintspot.sensor import configuration

        configuration.save(path, self)

    def replace(self, *, where: Sequence[int] | NDArray[Any] | int | None = None, **changes: Any) -> Settings:
        """Return settings with some values changed.

        Parameters
        ----------
        where : int or sequence of int, optional
            Sub-apertures to change; default all. A boolean array selects as in NumPy.
        **changes
            New values by name; with `where`, a scalar or one value per selected sub-aperture.

        Raises
        ------
        InputError
            For an unknown name, a bad value, an index out of range.
        """
        known = [f.name for f in fields(self)]
        for name in changes:
            one_of("settings.replace", name, known)
        if where is None:
            return dataclass_replace(self, **changes)
        selected = _indices(where)
        mixed = {}
        for name, value in changes.items():
            if name not in PER_SUBAPERTURE:
                raise InputError(f"{name}: expected one value for the whole sensor, not one for `where`")
            mixed[name] = _changed_at(name, getattr(self, name), selected, value)
        return dataclass_replace(self, **mixed)

    def values(self, name: str, n_subapertures: int, pixels: int) -> NDArray[Any]:
        """Return one value per sub-aperture, with defaults filled in.

        Raises
        ------
        InputError
            When the settings are for another number of sub-apertures, or `keep_brightest` is more than a
            window of `pixels` pixels allows.
        """
        value = getattr(self, name)
        if _is_array(value):
            if len(value) != n_subapertures:
                raise InputError(
                    f"{name}: expected {n_subapertures} values, one per sub-aperture, got {len(value)}"
                )
            return value  # type: ignore[no-any-return]
        if isinstance(value, PerSubaperture):
            beyond = [index for index in value.others if index >= n_subapertures]
            if beyond:
                raise InputError(
                    f"{name}: sub-aperture {beyond[0]} does not exist; there are {n_subapertures}"
                )
            default = self._default(name, pixels) if value.default is None else value.default
            return np.array([value.others.get(i, default) for i in range(n_subapertures)])
        return np.full(n_subapertures, self._default(name, pixels) if value is None else value)

    def _default(self, name: str, pixels: int) -> Any:
        of_preset = of_denoising(self.preset)
        if name in of_preset:
            return of_preset[name]
        if name == "keep_brightest":
            return min(max(FEWEST_KEPT, round(KEPT_FRACTION * pixels)), pixels - 1)
        if name == "smoothing_px":
            return 0.7
        return 0.0 if name == "noise_std" else math.nan  # where nothing is denoised; what is not set


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _same(a: Any, b: Any) -> bool:
    if _is_array(a) or _is_array(b):
        return _is_array(a) and _is_array(b) and np.array_equal(a, b)
    return bool(a == b)


def _lacks_strength(noise_std: Any, denoise: Any) -> bool:
    """Whether some sub-aperture is to be denoised but has no strength."""
    if _is_array(noise_std):
        return False
    places: set[int] = {-1}  # in a PerSubaperture, all that are not named
    if _is_array(denoise):
        places = set(range(len(denoise)))
    for value in (noise_std, denoise):
        if isinstance(value, PerSubaperture) and not _is_array(denoise):
            places |= set(value.others)

    def at(value: Any, place: int) -> Any:
        return value[place] if _is_array(value) or isinstance(value, PerSubaperture) else value

    return any(at(noise_std, place) is None and at(denoise, place) for place in places)


def _indices(where: Any) -> NDArray[np.int64]:
    """Sub-aperture numbers from an int, a sequence of int or a boolean mask."""
    array = np.atleast_1d(np.asarray(where))
    if array.dtype == np.bool_:
        array = np.flatnonzero(array)
    if array.size == 0:
        return np.empty(0, np.int64)
    return numbers_between("where", array, 0, integer=True).astype(np.int64)


def _changed_at(name: str, old: Any, selected: NDArray[np.int64], value: Any) -> Any:
    """Combine the old value with a new one in the selected places."""
    new = _checked(name, value)
    if _is_array(new) and len(new) != len(selected):
        raise InputError(f"{name}: expected one value or {len(selected)}, as many as `where`, got {len(new)}")
    if _is_array(old):
        if selected.max(initial=-1) >= len(old):
            raise InputError(f"where: sub-aperture {selected.max()} does not exist; there are {len(old)}")
        result = old.astype(np.result_type(old, np.asarray(new)))
        result[selected] = new
        return result
    others = dict(old.others) if isinstance(old, PerSubaperture) else {}
    each = new if _is_array(new) else [new] * len(selected)
    others.update({int(index): _plain(item) for index, item in zip(selected, each, strict=True)})
    return PerSubaperture(old.default if isinstance(old, PerSubaperture) else old, others)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _checked(name: str, value: Any) -> Any:
    """Check one setting, whatever its form; scalars become plain Python values, sequences arrays."""
    if isinstance(value, PerSubaperture):
        if None in value.others.values():
            raise InputError(f"{name}: expected a value for each sub-aperture that is named, got none")
        default = _checked(name, value.default)
        others = {int(index): _checked(name, item) for index, item in value.others.items()}
        return PerSubaperture(default, MappingProxyType(others))
    if value is None and name in _OPTIONAL:
        return None
    if name in ("noise_std", "keep_brightest") and isinstance(value, str) and value == AUTO:
        return AUTO
    if name == "rule":
        return _checked_each(name, value, lambda item: one_of("rule", item, RULES))
    if name == "denoise":
        return _checked_each(name, value, _checked_bool)
    array = _checked_numbers(name, value)
    if array.ndim > 1 or array.size == 0:
        raise InputError(f"{name}: expected a number or one per sub-aperture, got shape {array.shape}")
    if array.ndim == 0:
        return array.item()
    array = array.copy()
    array.flags.writeable = False
    return array


def _checked_numbers(name: str, value: Any) -> NDArray[Any]:
    low, high, low_open = _BOUNDS[name]
    return numbers_between(name, value, low, high, integer=name in _WHOLE, low_open=low_open)


def _checked_bool(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"denoise = {value!r}: expected true or false")
    return bool(value)


def _checked_each(name: str, value: Any, check: Any) -> Any:
    """Check a scalar, or each item of a sequence."""
    if isinstance(value, str | bool | np.bool_):
        return check(value)
    try:
        items = [check(item) for item in value]
    except TypeError:
        raise InputError(f"{name} = {value!r}: expected one value or one per sub-aperture") from None
    array = np.array(items)
    array.flags.writeable = False
    return array
