"""Settings: the estimator of a sensor, and the options that all estimators share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError, errors_within
from faintspot.base.options import Option, Options, PerSubaperture, check_lengths, option
from faintspot.base.tables import Tables, per_subaperture, save_tables
from faintspot.base.text_files import check_known
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimator_named, estimators


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedOptions(Options):
    """Options shared by all estimators."""

    search_range_px: Any = option(
        None,
        "Maximum distance from the reference position; larger slopes are clipped. Default: the whole window.",
        unit="px",
        low=0.0,
        high=1e4,
        low_open=True,
    )
    max_bad_fraction: object = option(
        0.25, "Fraction of bad pixels above which a sub-aperture is invalid.", low=0.0, high=1.0
    )
    error_scale: Any = option(1.0, "Factor applied to the standard errors.", low=0.0, high=1e3, low_open=True)
    flux_e: Any = option(
        None,
        'Expected flux of a spot in a frame, used by some estimators and for "auto". Default: the mean over '
        "all sub-apertures, measured in each frame.",
        unit="e-",
        low=0.0,
        high=1e12,
        low_open=True,
    )
    spot_fwhm_px: object = option(
        None,
        "Full width at half maximum of the spots in the frame, along x. Default: the width of the PSF.",
        unit="px",
        low=0.1,
        high=1e3,
    )
    spot_fwhm_y_px: object = option(
        None, "As spot_fwhm_px, along y. Default: the width along x.", unit="px", low=0.1, high=1e3
    )


class Settings:
    """Estimator of a sensor and its options; immutable.

    Parameters
    ----------
    estimator : str or Estimator
        Name from `estimators.estimators`, with the options of the estimator in `options`, or an
        estimator object. Default: "tv".
    **options
        Options of the estimator, and the shared options `search_range_px`, `max_bad_fraction`,
        `error_scale`, `flux_e`, `spot_fwhm_px` and `spot_fwhm_y_px`; see docs/configuration.md. Most
        options accept one value per sub-aperture. All are attributes of the settings.

    Raises
    ------
    InputError
        If an option is unknown or belongs to another estimator, a value is out of range, NaN or of the wrong
        type, or arrays have different lengths.

    Examples
    --------
    >>> import faintspot as fs
    >>> settings = fs.Settings(estimator="ml", model_error=0.1, search_range_px=2.0)
    >>> settings.estimator.label, settings.model_error
    ('maximum likelihood', 0.1)
    """

    SHARED: ClassVar[tuple[str, ...]] = tuple(SharedOptions.declared())

    estimator: Estimator
    """Estimator of the spot positions."""
    _shared: SharedOptions

    def __init__(self, estimator: str | Estimator = "tv", **options: object) -> None:
        if isinstance(estimator, Estimator):
            foreign = [name for name in options if name not in self.SHARED]
            if foreign:
                raise InputError(
                    f"{foreign[0]}: give it to the estimator's own object, as option of its class"
                )
            chosen = estimator
        else:
            kind = estimator_named(estimator)
            specific = {key: value for key, value in options.items() if key not in self.SHARED}
            for key in specific:
                check_option(key, kind)
            chosen = kind(**specific)
        put = object.__setattr__
        put(self, "estimator", chosen)
        put(self, "_shared", SharedOptions(**{k: v for k, v in options.items() if k in self.SHARED}))
        check_lengths(chosen, self._shared)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Settings are immutable: use settings.replace({name}=...)")

    def __getattr__(self, name: str) -> Any:
        """Return an option of the estimator or a shared option."""
        if name.startswith("_"):  # as asked for while settings are unpickled
            raise AttributeError(name)
        for part in (self._shared, self.estimator):
            if name in part.declared():
                return getattr(part, name)
        raise AttributeError(f"settings have no option {name!r}; there are {', '.join(self.declared())}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Settings):
            return NotImplemented
        return self.estimator == other.estimator and self._shared == other._shared

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        shown = {**self.estimator.chosen(), **self._shared.chosen()}
        options = "".join(f", {name}={value!r}" for name, value in shown.items())
        return f"Settings({self.estimator.name!r}{options})"

    def declared(self) -> dict[str, Option]:
        """Return the declarations of all options by name: first the estimator's, then the shared ones."""
        return {**self.estimator.declared(), **self._shared.declared()}

    def chosen(self) -> dict[str, Any]:
        """Return the options whose values are not the defaults."""
        return {**self.estimator.chosen(), **self._shared.chosen()}

    # Files ------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> Settings:
        """Read the tables [estimator] and [settings] of a configuration file (TOML)."""
        return cls.from_tables(Tables(path))

    @classmethod
    def from_tables(cls, tables: Tables) -> Settings:
        """Make settings from the tables of a configuration file.

        Raises
        ------
        InputError
            If a key is unknown or belongs to another estimator, or a value is invalid.
        """
        specific, shared = dict(tables["estimator"]), tables.tables.get("settings", {})
        with errors_within(tables.path):
            if "name" not in specific:
                known = ", ".join(estimators())
                raise InputError(f"expected one of {known}, found none", name="estimator.name")
            kind = estimator_named(specific.pop("name"))
        with errors_within(tables.path, "estimator."):
            for key in specific:
                check_option(key, kind)
        with errors_within(tables.path, "settings."):
            for key in shared:
                check_known("", key, cls.SHARED)
        with errors_within(tables.path, "estimator."):
            estimator = kind(**_plain_values(specific))
        with errors_within(tables.path, "settings."):
            return cls(estimator, **_plain_values(shared))

    def to_tables(self) -> dict[str, dict[str, Any]]:
        """Return the tables [estimator] and [settings] of a configuration file."""
        return {
            "estimator": {"name": self.estimator.name, **_without_none(self.estimator.chosen())},
            "settings": _without_none(self._shared.chosen()),
        }

    def save(self, path: str | Path) -> None:
        """Write the tables [estimator] and [settings] of a configuration file; preserve other tables."""
        save_tables(path, {name: values or None for name, values in self.to_tables().items()})

    # Changes ----------------------------------------------------------------------------------------

    def replace(self, *, where: Sequence[int] | NDArray[Any] | int | None = None, **changes: Any) -> Settings:
        """Return settings with some values changed.

        Parameters
        ----------
        where : int or sequence of int, optional
            Sub-apertures to change; default: all. A boolean array is a mask.
        **changes
            New values by name; with `where`, a scalar or one value per selected sub-aperture. If `estimator`
            changes, shared options are kept, and so are the options that the new estimator has as well.

        Raises
        ------
        InputError
            If a name is unknown, a value is invalid, or an index is out of range.
        """
        if where is None and "estimator" in changes:
            return self._with_estimator(**changes)
        shared = {name: value for name, value in changes.items() if name in self.SHARED}
        specific = {name: value for name, value in changes.items() if name not in self.SHARED}
        for name in specific:
            check_option(name, type(self.estimator))
        return self._of(self.estimator.replaced(specific, where), self._shared.replaced(shared, where))

    def _with_estimator(self, estimator: str | Estimator, **options: object) -> Settings:
        if isinstance(estimator, Estimator):
            return self._of(estimator, self._shared.replaced(options))
        kept = {
            key: getattr(self.estimator, key)
            for key in estimator_named(estimator).declared()
            if key in self.estimator.declared()
        }
        return Settings(estimator, **{**vars(self._shared), **kept, **options})

    @classmethod
    def _of(cls, estimator: Estimator, shared: SharedOptions) -> Settings:
        return cls(estimator, **vars(shared))

    def magnified(self, scale: float) -> Settings:
        """Return the settings with all stated distances, options whose names end in _px, times a factor."""
        options = self.declared()
        return self.replace(
            **{
                name: _times(value, scale, whole=options[name].whole)
                for name, value in self.chosen().items()
                if name.endswith("_px")
            }
        )

    def values(self, name: str, n_subapertures: int, pixels: int) -> NDArray[Any]:
        """Return one value per sub-aperture, with defaults filled in; NaN if there is none.

        Raises
        ------
        InputError
            If the settings are for another number of sub-apertures.
        """
        part = self._shared if name in self.SHARED else self.estimator
        return part.values(name, n_subapertures, pixels)


def check_option(name: str, kind: type[Estimator]) -> None:
    """Raise an error if the estimator does not have an option; name the estimators that do.

    Raises
    ------
    InputError
        If it has no such option.
    """
    if name in kind.declared():
        return
    others = [owner for owner, owner_kind in estimators().items() if name in owner_kind.declared()]
    if name in Settings.SHARED:
        raise InputError("expected in the table [settings], where all estimators look", name=name)
    if others:
        raise InputError(f"an option of {' and '.join(map(repr, others))}, not of {kind.name!r}", name=name)
    check_known("", name, [*kind.declared(), *Settings.SHARED], f"option of {kind.name!r}")


def _times(value: Any, scale: float, *, whole: bool) -> Any:
    """Return numbers times a factor; None and "auto" stay."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, PerSubaperture):
        others = {index: _times(other, scale, whole=whole) for index, other in value.others.items()}
        return PerSubaperture(_times(value.default, scale, whole=whole), others)
    scaled = np.multiply(value, scale)
    return (np.maximum(np.rint(scaled), 1).astype(int) if whole else scaled).tolist()


def _plain_values(values: Mapping[str, object]) -> dict[str, Any]:
    return {key: per_subaperture(key, value) for key, value in values.items()}


def _without_none(values: Mapping[str, object]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def without_denoising(settings: Settings, where: str) -> Settings:
    """Return settings with the same estimator without denoising.

    Raises
    ------
    InputError
        If the estimator does not denoise; the message begins with `where`.
    """
    plain = settings.estimator.without_denoising()
    if plain is None:
        raise InputError(
            f"{where}: the estimator {settings.estimator.name!r} ({settings.estimator.label}) does not "
            "denoise; leave this out, or set another estimator"
        )
    return settings.replace(estimator=plain)


def option_names() -> list[str]:
    """Return the names of all options of all estimators, and the shared ones, preceded by "estimator"."""
    specific = (name for kind in estimators().values() for name in kind.declared())
    return list(dict.fromkeys(["estimator", *specific, *Settings.SHARED]))


def spot_fwhm_px(settings: Settings, n_subapertures: int, pixels: int) -> NDArray[np.float64]:
    """Return the widths (n, 2) of the spots along x and y given by the settings; NaN where not given."""
    along, across = (
        settings.values(name, n_subapertures, pixels).astype(np.float64)
        for name in ("spot_fwhm_px", "spot_fwhm_y_px")
    )
    return np.column_stack([along, np.where(np.isnan(across), along, across)])


__all__ = ["Settings", "check_option", "option_names", "spot_fwhm_px", "without_denoising"]
