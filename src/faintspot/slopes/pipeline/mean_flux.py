"""Running mean of the flux of each sub-aperture, for frames that are too faint for a flux per frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import not_none, number_between, numbers_between, real_array
from faintspot.base.errors import InputError

_LEAST_FLUX_E = 1e-3


@dataclass(frozen=True, eq=False)
class MeanFlux:
    """Mean flux of each sub-aperture over the previous frames; an immutable value, updated frame by frame.

    ::

        light = fs.MeanFlux(first_frames_slopes.flux)
        for frame in frames:
            slopes = pipeline.with_flux(light)(frame)
            light = light.updated(slopes.flux)

    Parameters
    ----------
    flux_e : (n,) or (n_frames, n) array
        Flux [electrons] of one frame, or of several, which are averaged.
    time_constant_frames : float
        Number of frames after which the weight of a frame has decreased by a factor of e. The first frames,
        up to this number, are weighted equally.
    frames : float
        Number of frames averaged in `flux_e` (n,). Default: 1, or the number of frames given.

    Raises
    ------
    InputError
        If flux is not finite or of another shape, or a number is out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> light = fs.MeanFlux([100.0, 40.0])
    >>> print(light.updated([110.0, 60.0]).flux_e)
    [105.  50.]
    """

    flux_e: Any
    time_constant_frames: float = 1000.0
    frames: float | None = None

    def __post_init__(self) -> None:
        flux = numbers_between("flux_e", self.flux_e, -1e12, 1e12)
        if flux.ndim not in (1, 2):
            raise InputError(f"flux_e: expected shape (n,) or (n_frames, n), got {flux.shape}")
        number_between("time_constant_frames", self.time_constant_frames, 1.0)
        count = 1 if flux.ndim == 1 else len(flux)
        frames = number_between("frames", count if self.frames is None else self.frames, 0.0, low_open=True)
        mean = flux if flux.ndim == 1 else flux.mean(axis=0)
        mean.flags.writeable = False
        object.__setattr__(self, "flux_e", mean)
        object.__setattr__(self, "frames", float(frames))

    def updated(self, flux_e: ArrayLike) -> MeanFlux:
        """Return the mean updated by a frame's flux (n,) [electrons]; values that are not finite are ignored.

        Raises
        ------
        InputError
            If the number of sub-apertures differs.
        """
        flux = real_array("flux_e", flux_e)
        if flux.shape != self.flux_e.shape:
            raise InputError(f"flux_e: expected shape {self.flux_e.shape}, got {flux.shape}")
        frames = min(not_none(self.frames) + 1.0, self.time_constant_frames)
        change = np.where(np.isfinite(flux), flux - self.flux_e, 0.0) / frames
        return replace(self, flux_e=self.flux_e + change, frames=frames)

    @property
    def positive_flux_e(self) -> NDArray[np.float64]:
        """Mean flux, at least 0.001 electrons."""
        flux: NDArray[np.float64] = np.maximum(self.flux_e, _LEAST_FLUX_E)
        return flux
