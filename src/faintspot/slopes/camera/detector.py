"""Model of a camera's detector, from the mean flux on each pixel to the digitised image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between, spawn
from faintspot.base.errors import InputError
from faintspot.base.options import Options, number, setting

LARGEST_MEAN_E = 1e12
"""Largest mean number of electrons per pixel accepted (far above any full well)."""

_LEVELS = ("read_noise_e", "dark_e", "background_e", "relative_gain")  # numbers or maps


def _number_or_map(name: str, value: object) -> float | NDArray[np.float64]:
    """Return a level >= 0: a number, or a read-only map of shape (ny, nx)."""
    level: NDArray[np.float64] = numbers_between(name, value, 0, LARGEST_MEAN_E)
    if level.ndim == 0:
        return float(level)
    if level.ndim != 2:
        raise InputError(f"{name}: expected one number or a map (rows, columns), got shape {level.shape}")
    level.flags.writeable = False
    return level


def _single_pixels(name: str, value: object) -> tuple[tuple[int, int, float], ...]:
    """Return hot or blinking pixels as (row, column, electrons)."""
    if not isinstance(value, Sequence | np.ndarray):
        raise InputError(f"{name}: expected a list of (row, column, electrons), got {value!r}")
    if len(value) == 0:
        return ()
    table = finite_array(name, value)
    if table.ndim != 2 or table.shape[1] != 3:
        raise InputError(f"{name}: expected (row, column, electrons) for each, got shape {table.shape}")
    where = numbers_between(f"{name} row or column", table[:, :2], 0, 2**31, integer=True)
    levels = numbers_between(f"{name} electrons", table[:, 2], 0, LARGEST_MEAN_E)
    return tuple(
        (int(row), int(column), float(level)) for (row, column), level in zip(where, levels, strict=True)
    )


@dataclass(frozen=True, eq=False)
class Detector(Options):
    """A CCD, CMOS or electron-multiplying CCD with its noise.

    The effects are applied in this order: photo-electrons of the star, background and dark current (each
    Poisson), full well, multiplication register, read noise (Gaussian), conversion to ADU, quantisation.

    ADU are defined by ``adu = offset_adu + electrons_out / gain_e_per_adu``, where electrons_out is the
    output of the multiplication register plus the read noise. `to_electrons` converts back to
    photo-electrons, ``(adu - offset_adu) * gain_e_per_adu / em_gain``. With the default offset and gain,
    and no multiplication, ADU are electrons.

    Each source of noise has its own generator, so that changing one does not change the draws of the others.

    Parameters
    ----------
    read_noise_e : float or array_like, shape (ny, nx)
        Standard deviation of the read noise in electrons at the output, after multiplication; in
        photo-electrons it is read_noise_e / em_gain. Any number >= 0; not rounded.
    dark_e : float or array_like, shape (ny, nx)
        Mean electrons per pixel and frame from dark current and clock-induced charge.
    background_e : float or array_like, shape (ny, nx)
        Mean photo-electrons per pixel and frame from the sky and stray light.
    em_gain : float
        Mean gain of the multiplication register; 1 is a detector without one. For n electrons in, the
        output is Gamma distributed with shape n and scale em_gain (Basden, Haniff & Mackay 2003, MNRAS
        345, 985), the limit for a gain much above 1.
    gain_e_per_adu : float
        Electrons (after multiplication) per ADU.
    offset_adu : float
        Level added to every pixel. With `bits`, values below 0 ADU are clipped: use an offset of several
        times the read noise.
    bits : int or None
        Bits of the analogue-to-digital converter, 1 to 32: values are rounded to whole ADU and saturate at
        0 and at 2**bits - 1. None leaves them continuous.
    full_well_e : float or None
        Maximum number of electrons in a pixel before multiplication.
    hot_pixels : sequence of (row, column, electrons)
        Pixels with additional dark electrons per frame (mean), on top of `dark_e`.
    blinking_pixels : sequence of (row, column, electrons)
        Pixels with random telegraph noise: two levels at the output, so many electrons apart, drawn anew for
        each frame with equal probability. Their mean is that of other pixels.
    relative_gain : float or array_like, shape (ny, nx)
        Gain of each pixel's amplifier relative to the nominal one, the `flat` of a calibration: ADU above the
        offset are multiplied by it.

    Raises
    ------
    InputError
        If a value is not finite or out of range, or maps have different shapes.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.simulate import Detector
    >>> emccd = Detector(50.0, em_gain=500.0, gain_e_per_adu=10.0, offset_adu=200.0, bits=14)
    >>> adu = emccd.expose(np.full((1000, 8, 8), 3.0), np.random.default_rng(1))
    >>> electrons = emccd.to_electrons(adu)
    >>> print(f"{adu.dtype}: mean {electrons.mean():.1f}, variance {electrons.var():.1f} e-")
    uint16: mean 3.0, variance 5.9 e-
    """

    read_noise_e: float | NDArray[np.float64] = setting(
        0.1, "Read noise at the output.", unit="e-", check=_number_or_map
    )
    _: KW_ONLY
    dark_e: float | NDArray[np.float64] = setting(
        0.0, "Dark current per pixel and frame.", unit="e-", check=_number_or_map
    )
    background_e: float | NDArray[np.float64] = setting(
        0.0, "Sky per pixel and frame.", unit="e-", check=_number_or_map
    )
    em_gain: float = number(1.0, 1, np.inf, "EM gain; 1: none.")
    gain_e_per_adu: float = number(1.0, 0, np.inf, "Electrons per ADU.", unit="e-/ADU", low_open=True)
    offset_adu: float = number(0.0, -np.inf, np.inf, "Level of every pixel.", unit="ADU")
    bits: int | None = number(None, 1, 32, "Bits of the converter, for whole ADU.", whole=True)
    full_well_e: float | None = number(None, 0, np.inf, low_open=True)
    hot_pixels: Sequence[tuple[int, int, float]] = setting((), check=_single_pixels)
    blinking_pixels: Sequence[tuple[int, int, float]] = setting((), check=_single_pixels)
    relative_gain: float | NDArray[np.float64] = setting(1.0, check=_number_or_map)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.all(np.asarray(self.relative_gain) > 0):
            raise InputError("relative_gain: expected numbers above 0, got 0")

    @classmethod
    def cmos(
        cls,
        shape: tuple[int, int],
        read_noise_e: float = 1.0,
        *,
        spread: float = 0.5,
        blinking_fraction: float = 0.0,
        blinking_e: float = 10.0,
        gain_spread: float = 0.0,
        rng: np.random.Generator | None = None,
        **options: Any,
    ) -> Detector:
        """Return a CMOS camera, whose pixels have amplifiers of their own.

        The read noise follows a log-normal distribution, with a tail of noisy pixels. The effect of such
        distributions on slopes was studied by Basden (2015, JATIS 1, 039002; arXiv:1506.07929).

        Parameters
        ----------
        shape : (int, int)
            Rows and columns of a frame.
        read_noise_e : float
            Median read noise [electrons].
        spread : float
            Standard deviation of the logarithm of the read noise: root mean square over median is
            exp(spread^2).
        blinking_fraction : float
            Fraction of the pixels that blink, see `blinking_pixels`.
        blinking_e : float
            Mean distance of their two levels [electrons], of an exponential distribution.
        gain_spread : float
            Standard deviation of `relative_gain`.
        rng : numpy.random.Generator, optional
            Generator of the camera's pixels.
        options
            Other parameters of `Detector`.

        Raises
        ------
        InputError
            If a value is out of range.

        Examples
        --------
        >>> import numpy as np, faintspot as fs
        >>> camera = fs.slopes.simulate.Detector.cmos((64, 64), 1.0, spread=0.7, rng=np.random.default_rng(1))
        >>> noise = camera.read_noise_e
        >>> print(f"median {np.median(noise):.1f} e-, rms {np.sqrt(np.mean(noise**2)):.1f} e-")
        median 1.0 e-, rms 1.6 e-
        """
        median = number_between("read_noise_e", read_noise_e, 0.0)
        fraction = number_between("blinking_fraction", blinking_fraction, 0.0, 1.0)
        noise, gain, where, step = spawn(rng, 4)
        pixels = noise.lognormal(0.0, number_between("spread", spread, 0.0, 3.0), shape)
        relative = gain.normal(1.0, number_between("gain_spread", gain_spread, 0.0, 0.2), shape)
        blinking = np.argwhere(where.random(shape) < fraction)
        steps = step.exponential(number_between("blinking_e", blinking_e, 0.0), len(blinking))
        return cls(
            median * pixels,
            blinking_pixels=np.column_stack([blinking, steps]),  # type: ignore[arg-type]
            relative_gain=np.maximum(relative, 0.01),
            **options,
        )

    @property
    def excess_noise_factor(self) -> float:
        """Factor of the multiplication register on the variance of the electrons: 2, or 1 without one.

        It is F^2 of Robbins & Hadwen (2003, IEEE Trans. Electron Devices 50, 1227) in the limit of large
        gain, which is exact for the Gamma distribution of this register.
        """
        return 2.0 if self.em_gain > 1 else 1.0

    def expose(
        self, mean_e: ArrayLike, rng: np.random.Generator | None = None
    ) -> NDArray[np.float32] | NDArray[np.uint16] | NDArray[np.uint32]:
        """Return one simulated read-out for each image of mean photo-electrons.

        Parameters
        ----------
        mean_e : array_like, shape (..., ny, nx)
            Mean photo-electrons per pixel from the star, 0 to 1e12. Zeros give dark frames (with sky).
        rng : numpy.random.Generator, optional
            Generator of the noise.

        Returns
        -------
        ndarray, shape (..., ny, nx)
            Read-out [ADU]: float32, or with `bits` uint16 (up to 16 bits) or uint32.

        Raises
        ------
        InputError
            If `mean_e` is negative or not finite, or its images do not match the shape of the detector's
            maps or do not contain its hot pixels.
        """
        mean = self._checked_mean(mean_e)
        photon, dark, background, register, read, *blinking = spawn(rng, 5 + bool(self.blinking_pixels))
        electrons = photon.poisson(mean).astype(np.float64)
        for generator, level in ((dark, self._dark_map(mean.shape)), (background, self.background_e)):
            if np.any(level):
                electrons += generator.poisson(level, mean.shape)
        if self.full_well_e is not None:
            np.minimum(electrons, self.full_well_e, out=electrons)
        if self.em_gain > 1:
            electrons = self.em_gain * register.standard_gamma(electrons)
        if np.any(self.read_noise_e):
            electrons += self.read_noise_e * read.standard_normal(mean.shape)
        for row, column, step in self.blinking_pixels:
            electrons[..., row, column] += step * (blinking[0].integers(0, 2, mean.shape[:-2]) - 0.5)
        return self._digitise(electrons)

    def to_electrons(self, adu: ArrayLike) -> NDArray[np.float32] | NDArray[np.float64]:
        """Return the photo-electrons of a read-out.

        They are (adu - offset_adu) * gain_e_per_adu / (em_gain * relative_gain). Background and dark current
        are not subtracted.

        Parameters
        ----------
        adu : array_like
            Read-out of `expose`, any shape.

        Returns
        -------
        ndarray, same shape
            Photo-electrons; float64 if `adu` is, otherwise float32.

        Raises
        ------
        InputError
            If `adu` is not finite.
        """
        values = finite_array("adu", adu)
        scale = self.gain_e_per_adu / self.em_gain / self.relative_gain
        electrons = (values.astype(np.float64) - self.offset_adu) * scale
        return electrons if values.dtype == np.float64 else electrons.astype(np.float32)

    def variance(self, mean_e: ArrayLike) -> NDArray[np.float64]:
        """Return the variance [photo-electrons^2] of a read-out converted to photo-electrons.

        It is excess_noise_factor * (mean_e + dark + background) + (read_noise_e / em_gain)^2, with `bits` one
        twelfth of an ADU squared, and in blinking pixels a quarter of their step squared. Saturation and full
        well are ignored, and the term of the ADU is valid if the noise is at least half an ADU.

        Parameters
        ----------
        mean_e : array_like, shape (..., ny, nx)
            Mean photo-electrons per pixel from the star.

        Returns
        -------
        ndarray, float64, shape (..., ny, nx)

        Raises
        ------
        InputError
            As for `expose`.
        """
        mean = self._checked_mean(mean_e)
        collected = mean + self._dark_map(mean.shape) + self.background_e
        at_output = np.square(self.read_noise_e)
        if self.bits is not None:
            at_output = at_output + np.square(self.gain_e_per_adu / self.relative_gain) / 12
        if self.blinking_pixels:
            at_output = np.broadcast_to(at_output, mean.shape[-2:]).copy()
            for row, column, step in self.blinking_pixels:
                at_output[row, column] += 0.25 * step**2
        variance: NDArray[np.float64] = self.excess_noise_factor * collected + at_output / self.em_gain**2
        return variance

    def _checked_mean(self, mean_e: ArrayLike) -> NDArray[np.float64]:
        """Return the mean images as float64; raise an error if they do not fit the detector."""
        mean: NDArray[np.float64] = numbers_between("mean_e", mean_e, 0, LARGEST_MEAN_E)
        if mean.ndim < 2:
            raise InputError(f"mean_e: expected shape (..., rows, columns), got {mean.shape}")
        for name in _LEVELS:
            expected = np.shape(getattr(self, name))
            if expected not in ((), mean.shape[-2:]):
                raise InputError(f"mean_e: expected images of shape {expected}, as {name}, got {mean.shape}")
        for row, column, _ in (*self.hot_pixels, *self.blinking_pixels):
            if row >= mean.shape[-2] or column >= mean.shape[-1]:
                raise InputError(
                    f"mean_e: hot or blinking pixel ({row}, {column}) is outside images of {mean.shape[-2:]}"
                )
        return mean

    def _dark_map(self, shape: tuple[int, ...]) -> float | NDArray[np.float64]:
        """Return the mean dark electrons, including hot pixels, for images of shape (..., ny, nx)."""
        if not self.hot_pixels:
            return self.dark_e
        dark = np.broadcast_to(self.dark_e, shape[-2:]).copy()
        for row, column, electrons in self.hot_pixels:
            dark[row, column] += electrons
        return dark

    def _digitise(
        self, electrons_out: NDArray[np.float64]
    ) -> NDArray[np.float32] | NDArray[np.uint16] | NDArray[np.uint32]:
        """Convert electrons at the output to ADU; round and saturate them if `bits` is set."""
        adu = self.offset_adu + self.relative_gain * electrons_out / self.gain_e_per_adu
        if self.bits is None:
            return adu.astype(np.float32)
        counts = np.clip(np.rint(adu), 0, 2**self.bits - 1)
        return counts.astype(np.uint16) if self.bits <= 16 else counts.astype(np.uint32)


def detector_or_default(detector: object) -> Detector:
    """Return the detector; the default has 0.1 e- read noise and no other noise.

    Raises
    ------
    InputError
        If it is something else.
    """
    if detector is None:
        return Detector(read_noise_e=0.1)
    if not isinstance(detector, Detector):
        raise InputError(f"detector: expected a Detector or None, got {type(detector).__name__}")
    return detector
