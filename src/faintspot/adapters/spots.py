"""Spot positions for tools that cut out the windows themselves."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import AdapterOptions, ToolSlopes
from faintspot.adapters.checks import predicted
from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.layout import Layout


class SpotOptions(AdapterOptions, total=False):
    """Options of adapters for tools that cut out the windows themselves."""

    predict: Any


class Spots:
    """Spot positions in a tool's windows, with the tool's references and predictions.

    Parameters
    ----------
    tool : str
        Name of the tool, for errors.
    n, side : int
        Number of windows, and their side in pixels.
    settings, calibration
        See `ToolSlopes`.
    predict : callable or object with `predict`, optional
        See `faintspot.adapters.checks.predicted`: slopes in the tool's order and unit.
    rows_first : bool
        Whether the tool puts coordinates along rows (y) before those along columns (x).
    **options
        See `ToolSlopes`.
    """

    def __init__(
        self,
        tool: str,
        n: int,
        side: int,
        settings: Settings,
        calibration: Calibration | None,
        *,
        predict: object = None,
        rows_first: bool = False,
        **options: Unpack[AdapterOptions],
    ) -> None:
        self._tool, self._shape, self._predict = tool, (n, side, side), predict
        self._order = slice(None, None, -1 if rows_first else 1)
        layout = Layout.stacked(n, (side, side))
        self.measured = ToolSlopes(layout, settings, calibration, **options)
        self._slopes: NDArray[np.float64] | None = None

    def checked(self, images: object) -> NDArray[Any]:
        """Return a tool's images after checking their number and size.

        Raises
        ------
        InputError
            When there is another number of images, or another size.
        """
        array = np.asarray(images)
        if array.shape != self._shape:
            raise InputError(
                f"{self._tool}'s images: expected shape {self._shape}, got {array.shape}; attach faintspot "
                "again after changing the sensor"
            )
        return array

    def places(
        self, images: NDArray[Any], reference: NDArray[np.float64], unit: float = 1.0, *, noise_free: bool
    ) -> NDArray[np.float64]:
        """Return the spot positions in pixels from the windows' centres, in the tool's order: (2, n).

        Parameters
        ----------
        images : (n, side, side) array
            Images returned by `checked`.
        reference : (2, n) array
            The tool's reference positions, in the same coordinates. Invalid spots get them, too.
        unit : float
            Pixels per unit of the tool's slopes.
        noise_free : bool
            Whether the tool declares these images as noise-free calibration images.

        Raises
        ------
        InputError
            As for `ToolSlopes.measure`.
        """
        n, side = self._shape[:2]
        noise_free = noise_free or self.measured.noise_free
        prior = None
        if not noise_free:
            slopes = predicted(self._predict, self._slopes, (2 * n,))
            if slopes is not None:
                prior = (slopes.reshape(2, n) * unit + reference)[self._order].ravel()
        found = self.measured.measure(images.reshape(-1, side), prior_px=prior, noise_free=noise_free)[
            self._order
        ]
        found = np.where(self.measured.last.measured, found, reference)
        if not noise_free:
            self._slopes = ((found - reference) / unit).ravel()
        return found
