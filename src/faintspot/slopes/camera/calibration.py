"""Calibration: from raw frames in ADU to photo-electrons; binning of frames and of their calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, number_between, numbers_between, real_array
from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import derived, save_arrays
from faintspot.base.options import TEXTS, number, setting
from faintspot.base.tables import ConfigurationTable, Tables, is_map, save_tables

_BLOCK_PIXELS = 1 << 22  # processed at a time
_ESTIMATED = ("dark", "gain_e_per_adu", "saturation_adu", "bad_pixels", "read_noise_e")
_MAPS = ("dark", "flat", "bad_pixels", "read_noise_e")
# Limit of values that the kernels square in float32, with a wide margin; no camera reaches it.
_GAINS = 1e-9, 1e9
_LARGEST_READ_NOISE_E, _LARGEST_BACKGROUND_E, _LARGEST_ADU = 1e6, 1e9, 1e30


def _map(name: str, value: object) -> NDArray[np.float64]:
    """Return a private, read-only copy of a map, which may contain NaN."""
    rows = [row for row in value if isinstance(row, list)] if isinstance(value, list) else []
    if any(isinstance(item, bool) for row in rows for item in row):
        raise InputError("expected numbers, got true or false", name=name)
    array = real_array(name, value).astype(np.float64)
    check_shape(name, array, ("h", "w"))
    array.flags.writeable = False
    return array


def _scalar_or_map(name: str, value: object) -> object:
    if real_array(name, value).ndim == 0:
        return number_between(name, value, -_LARGEST_ADU, _LARGEST_ADU)
    return _map(name, value)


def _read_noise(name: str, value: object) -> object:
    """Return a number, or a map whose values are in range or NaN, not all of them NaN."""
    if real_array(name, value).ndim == 0:
        return number_between(name, value, 0.0, _LARGEST_READ_NOISE_E)
    noise = _map(name, value)
    finite = noise[~np.isnan(noise)]
    if finite.size == 0:
        raise InputError("expected the noise of at least one pixel, every value is NaN", name=name)
    numbers_between(name, finite, 0.0, _LARGEST_READ_NOISE_E)
    return noise


def _mask_or_list(name: str, value: object) -> NDArray[np.generic]:
    """Return a boolean mask, or rows and columns as (n, 2) int64."""
    try:
        array = np.array(value)
    except ValueError:
        raise InputError("expected [row, column] in every row of the list", name=name) from None
    if array.dtype != np.bool_:
        if array.size == 0:
            array = np.empty((0, 2), np.int64)
        if array.size:
            array = numbers_between(name, array, 0, 2**31, integer=True)
        if array.ndim != 2 or array.shape[1] != 2:
            got = f"{array.dtype} of shape {array.shape}"
            raise InputError(
                f"expected a boolean map (h, w) or a list of [row, column], got {got}", name=name
            )
    elif array.ndim != 2:
        raise InputError(f"expected shape (h, w), got {array.shape}", name=name)
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class Calibration(ConfigurationTable, table="calibration"):
    """Conversion of raw frames to electrons: (raw - dark) * gain_e_per_adu / (em_gain * flat); immutable.

    Parameters
    ----------
    dark : float or (h, w) array, optional, ADU
        Frame without flux: bias and dark current. NaN marks a bad pixel. Default: unknown, and treated as
        0. A value of 0 states that there is none.
    estimated : tuple of str
        Names of fields that were estimated from frames with light in them, such as a `dark` that is their
        background. `faintspot layout` estimates them again; estimators may fit an estimated dark level.
    flat : (h, w) array, optional
        Relative response of each pixel, 1 on average. NaN, zero or negative marks a bad pixel.
    gain_e_per_adu : float
        Electrons per ADU at the camera's output.
    em_gain : float
        Multiplication gain of an EMCCD; 1 for other cameras.
    bad_pixels : (h, w) array of bool, or (n, 2) array of row and column, optional
        Pixels to ignore; they are filled in from their neighbours within the sub-aperture.
    saturation_adu : float, optional
        Raw value at which a pixel is saturated. Default: the largest value of the integer dtype of the
        frames; none for floating-point frames.
    read_noise_e : float or (h, w) array, optional
        Standard deviation of the read noise in electrons at the camera's output, after multiplication; in
        photo-electrons it is read_noise_e / em_gain. A map gives that of each pixel; NaN marks a bad pixel.
        Required for standard errors and for the estimators "ml" and "map".
    background_e : float
        Mean background of sky and dark current per pixel and frame [photo-electrons], whose mean is
        subtracted with `dark` and whose noise remains.

    Raises
    ------
    InputError
        If a value is out of range, or arrays have different shapes.

    Examples
    --------
    >>> import faintspot as fs
    >>> emccd = fs.Calibration(dark=200.0, gain_e_per_adu=10.0, em_gain=500.0, read_noise_e=50.0)
    >>> emccd.read_noise_photoelectrons, emccd.excess_noise
    (0.1, 2.0)
    """

    dark: Any = setting(None, unit="ADU", check=_scalar_or_map)
    flat: Any = setting(None, check=_map)
    gain_e_per_adu: float = number(1.0, *_GAINS, "Electrons per ADU.", unit="e-/ADU")
    em_gain: float = number(1.0, *_GAINS, "EM gain; 1: none.")
    bad_pixels: Any = setting(None, check=_mask_or_list)
    saturation_adu: float | None = number(None, 0.0, _LARGEST_ADU, unit="ADU", low_open=True)
    read_noise_e: Any = setting(None, "Read noise at the output.", unit="e-", check=_read_noise)
    background_e: float = number(0.0, 0.0, _LARGEST_BACKGROUND_E, unit="e-")
    estimated: tuple[str, ...] = setting((), kind=TEXTS, choices=_ESTIMATED)

    def __post_init__(self) -> None:
        super().__post_init__()
        shapes = {name: array.shape for name, array in self._arrays().items()}
        if len(set(shapes.values())) > 1:
            text = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise InputError(f"calibration: expected maps of one shape, got {text}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Calibration):
            return NotImplemented
        own, theirs = vars(self), vars(other)
        return all(
            (own[name] is None) == (theirs[name] is None)
            and (own[name] is None or np.array_equal(own[name], theirs[name], equal_nan=name != "estimated"))
            for name in own
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def excess_noise(self) -> float:
        """Factor of the multiplication register on the variance of the electrons: 2, or 1 without one."""
        return 2.0 if self.em_gain > 1 else 1.0

    @property
    def dark_is_known(self) -> bool:
        """Whether the dark level is known accurately; otherwise estimators may fit it."""
        return self.dark is not None and "dark" not in self.estimated

    @property
    def typical_read_noise_e(self) -> float | None:
        """Read noise as one number: the root mean square of a map; None if unknown."""
        noise = self.read_noise_e
        if isinstance(noise, np.ndarray):
            return math.sqrt(float(np.nanmean(np.square(noise))))
        return noise  # type: ignore[no-any-return]

    @property
    def read_noise_photoelectrons(self) -> float | None:
        """`typical_read_noise_e` divided by the multiplication gain; None if unknown."""
        noise = self.typical_read_noise_e
        return None if noise is None else noise / self.em_gain

    def read_noise_map(self, frame_shape: tuple[int, int]) -> NDArray[np.float64] | None:
        """Return the read noise of each pixel [photo-electrons], NaN in bad ones; None if it is one number.

        Raises
        ------
        InputError
            If the map does not fit the frame.
        """
        if not isinstance(self.read_noise_e, np.ndarray):
            return None
        good = np.isfinite(self.maps(frame_shape)).all(axis=0)
        return np.where(good, self.read_noise_e / self.em_gain, np.nan)

    def with_bad_pixels(self, rows_and_columns: NDArray[np.int64]) -> Calibration:
        """Return the same calibration with further bad pixels, (n, 2)."""
        bad = self.bad_pixels
        if bad is None:
            bad = np.empty((0, 2), np.int64)
        elif bad.dtype == np.bool_:
            bad = np.argwhere(bad)
        return replace(self, bad_pixels=np.unique(np.concatenate([bad, rows_and_columns]), axis=0))

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read the table [calibration] of a configuration file (TOML); the default if there is none."""
        return cls.from_table(Tables(path).tables.get(cls.table, {}), Path(path))

    @classmethod
    def from_table(cls, values: Mapping[str, object], path: Path | None = None) -> Calibration:
        """Return the calibration in a table, with the maps in the files that it names."""
        with errors_within(path):
            read = {key: _map_or_value(path or Path(), key, value) for key, value in values.items()}
        return super().from_table(read, path)

    def save(self, path: str | Path) -> None:
        """Write the table [calibration] of a configuration file (TOML); other tables stay as they are."""
        path = Path(path)
        values = super().to_table()
        maps = {key: value for key, value in values.items() if is_map(value)}
        store = derived(path, ".calibration.npz")
        if maps:
            save_arrays(store, maps)
        save_tables(path, {"calibration": {**values, **{key: f"{store.name}:{key}" for key in maps}}})

    def to_table(self) -> dict[str, object]:
        """Return the table of a configuration file, in which maps are represented by their shapes."""
        values = super().to_table()
        return {key: f"map of {value.shape}" if is_map(value) else value for key, value in values.items()}

    def _arrays(self) -> dict[str, NDArray[np.generic]]:
        """Maps with the size of a frame."""
        arrays = {name: getattr(self, name) for name in _MAPS}
        return {
            name: value
            for name, value in arrays.items()
            if isinstance(value, np.ndarray) and not (name == "bad_pixels" and value.dtype != np.bool_)
        }

    def maps(self, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return dark [ADU] and electrons per ADU of each pixel, NaN in bad ones: (2, h, w) float32.

        Raises
        ------
        InputError
            If a map or a bad pixel does not fit into the frame.
        """
        self._check_shapes(frame_shape)
        maps = np.empty((2, *frame_shape), np.float32)
        with np.errstate(over="ignore"):  # values that overflow float32 become infinite: bad pixels
            maps[0] = 0.0 if self.dark is None else self.dark
            gain = np.full(frame_shape, self.gain_e_per_adu / self.em_gain)
            if self.flat is not None:
                usable = np.isfinite(self.flat) & (self.flat > 0)
                gain = np.divide(gain, self.flat, where=usable, out=np.full(frame_shape, np.nan))
            if self.bad_pixels is not None:
                gain[self._bad_mask(frame_shape)] = np.nan
            if isinstance(self.read_noise_e, np.ndarray):
                gain[np.isnan(self.read_noise_e)] = np.nan
            maps[1] = gain
        return maps

    def saturation(self, dtype: np.dtype[Any]) -> float:
        """Return the raw value at which pixels of this dtype are saturated (NaN: none)."""
        if self.saturation_adu is not None:
            return self.saturation_adu
        # Not infinity, which an infinite pixel would reach.
        return float(np.iinfo(dtype).max) if dtype.kind in "iu" else math.nan

    def _check_shapes(self, frame_shape: tuple[int, int]) -> None:
        """Raise an error if a map does not have the frame's shape."""
        for name, array in self._arrays().items():
            if array.shape != frame_shape:
                raise InputError(
                    f"calibration.{name}: expected the frame's shape {frame_shape}, got {array.shape}"
                )

    def _bad_mask(self, frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
        if self.bad_pixels.dtype == np.bool_:
            return self.bad_pixels  # type: ignore[no-any-return]
        outside = np.any(self.bad_pixels >= np.array(frame_shape), axis=1)
        if outside.any():
            pixel = tuple(int(i) for i in self.bad_pixels[np.argmax(outside)])
            raise InputError(f"calibration.bad_pixels: (row, column) {pixel} is outside {frame_shape}")
        mask = np.zeros(frame_shape, bool)
        mask[self.bad_pixels[:, 0], self.bad_pixels[:, 1]] = True
        return mask


def read_map(key: str, location: str | Path) -> NDArray[Any]:
    """Read `dark` or `flat` (the mean of several frames), `read_noise_e` (one map), or `bad_pixels`.

    Bad pixels are a map of nonzero values, or rows of (row, column).

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    from faintspot.io.frames import open_frames, read_array  # few calibrations have maps in files

    if key != "bad_pixels":
        with open_frames([location]) as frames:
            if key == "read_noise_e" and frames.n_frames > 1:
                raise InputError(f"{location}: expected one map of the read noise, got {frames.n_frames}")
            total = np.zeros(frames.shape)
            for _, block in frames.blocks(0, frames.n_frames, max(1, _BLOCK_PIXELS // total.size)):
                total += block.sum(axis=0, dtype=np.float64)
            return total / frames.n_frames
    array = read_array(location)
    if array.ndim == 2 and array.shape[1] == 2:
        return array
    bad = np.asarray((array != 0) | ~np.isfinite(array))
    if 2 * np.count_nonzero(bad) > bad.size and len(np.unique(array)) > 2:
        raise InputError(
            f"{location}: expected a map that is 0 in good pixels, {np.mean(bad):.0%} are not, with many "
            "values as in an image"
        )
    return bad


def _map_or_value(path: Path, key: str, value: object) -> object:
    """Read the map named in a configuration file, relative to that file."""
    if key not in _MAPS or not isinstance(value, str):
        return value
    with errors_within(f"calibration.{key}"):
        return read_map(key, str(path.parent / value))


def blocks(array: ArrayLike, factor: int) -> NDArray[Any]:
    """Return blocks of pixels: (..., h, w) as (..., h // factor, w // factor, factor^2).

    Rows and columns that fill no block are left out.
    """
    values = np.asarray(array)
    height, width = (side // factor for side in values.shape[-2:])
    whole = values[..., : height * factor, : width * factor]
    split = whole.reshape(*values.shape[:-2], height, factor, width, factor)
    return np.moveaxis(split, -3, -2).reshape(*values.shape[:-2], height, width, factor**2)


def binned(frames: ArrayLike, factor: int, saturation: float = np.nan) -> NDArray[np.float32]:
    """Return the sum of each block of factor x factor pixels, float32; NaN where one pixel is not finite.

    A block with a saturated pixel becomes saturated as a whole: at least factor^2 times `saturation`.
    """
    array = np.asarray(frames)
    height, width = (side // factor * factor for side in array.shape[-2:])
    # Strided parts of the frame: several times as fast as a reduction over blocks.
    parts = [array[..., y:height:factor, x:width:factor] for y in range(factor) for x in range(factor)]
    total = np.zeros(parts[0].shape)
    with np.errstate(over="ignore", invalid="ignore"):
        for part in parts:
            total += part
        sums = total.astype(np.float32)
    if not np.isnan(saturation):
        level = np.nextafter(np.float32(saturation * factor**2), np.float32(np.inf))
        saturated = np.zeros(sums.shape, bool)
        for part in parts:
            saturated |= part >= saturation
        sums[saturated & (sums < level)] = level
    return sums


def spread(images: ArrayLike, factor: int) -> NDArray[np.float32]:
    """Return images with each pixel spread evenly over the block that it is the sum of."""
    values = np.asarray(images, np.float32) / np.float32(factor**2)
    return values.repeat(factor, axis=-2).repeat(factor, axis=-1)


def binned_calibration(calibration: Calibration, factor: int, frame_shape: tuple[int, int]) -> Calibration:
    """Return the calibration of binned frames: dark levels and variances add up, and the gain stays.

    A block with a bad pixel is bad. The flat field is the mean of the block.
    """
    n = factor**2
    values: dict[str, Any] = {"background_e": calibration.background_e * n}
    if calibration.saturation_adu is not None:
        values["saturation_adu"] = calibration.saturation_adu * n
    if isinstance(calibration.dark, np.ndarray):
        values["dark"] = blocks(calibration.dark, factor).sum(axis=-1)
    elif calibration.dark is not None:
        values["dark"] = calibration.dark * n
    if isinstance(calibration.read_noise_e, np.ndarray):
        values["read_noise_e"] = np.sqrt(np.square(blocks(calibration.read_noise_e, factor)).sum(axis=-1))
    elif calibration.read_noise_e is not None:
        values["read_noise_e"] = calibration.read_noise_e * factor
    if calibration.flat is not None:
        values["flat"] = blocks(calibration.flat, factor).mean(axis=-1)
    bad = ~np.isfinite(calibration.maps(frame_shape)).all(axis=0)
    if bad.any():
        values["bad_pixels"] = blocks(bad, factor).any(axis=-1)
    return replace(calibration, **values)


def camera_calibration(calibration: Calibration, factor: int) -> Calibration:
    """Return the calibration of the camera whose binned frames have this one, without maps but the dark."""
    n, dark, noise = factor**2, calibration.dark, calibration.typical_read_noise_e
    if isinstance(dark, np.ndarray):
        dark = spread(dark, factor)
    elif dark is not None:
        dark /= n
    return Calibration(
        dark=dark,
        estimated=tuple(name for name in calibration.estimated if name == "dark"),
        gain_e_per_adu=calibration.gain_e_per_adu,
        em_gain=calibration.em_gain,
        read_noise_e=None if noise is None else noise / factor,
        background_e=calibration.background_e / n,
    )
