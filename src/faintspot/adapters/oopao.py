"""The slope pipeline in OOPAO (Heritier et al. 2023, AO4ELT7), in place of its sensor's centroiding."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import AdapterOptions, ToolSlopes, check_version, predicted
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
        See `faintspot.adapters.base.predicted`: slopes in the tool's order and unit.
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


TESTED = "1.0.0"
_LEAST_UNIT = 1e-6  # smallest unit of OOPAO's slopes; a tilt of one pixel gives about 1


def attach(
    wfs: object,
    settings: Settings,
    calibration: Calibration | None = None,
    **options: Unpack[SpotOptions],
) -> OOPAOAttachment:
    """Make an OOPAO `ShackHartmann` measure its slopes with faintspot, and recalibrate it.

    Reference slopes and `slopes_units` are remade (`initialize_wfs`). Interaction matrices and reconstructors
    made afterwards have the unit and order of OOPAO's own.

    Parameters
    ----------
    wfs : OOPAO.ShackHartmann.ShackHartmann
        A diffractive sensor without a weighting map of its own.
    settings : Settings
    calibration : Calibration, optional
        Default: images are in electrons.
    predict : callable or object with `predict`, optional
        Takes the last `wfs.signal`, (2 n,), and returns the prediction for the next frame, for estimators
        that use a prior; called before each frame except the first. For an asterism, a list with one for each
        source.
    **options
        psf, score, calibration_flux_e, flux_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

    Returns
    -------
    OOPAOAttachment
        `calibrating`, `measured`, `recorded`; `detach()` restores OOPAO's own centroiding.

    Raises
    ------
    InputError
        When the sensor is of another kind, geometric or has a weighting map, or as for `ToolSlopes`.
    """
    return OOPAOAttachment(wfs, settings, calibration, options)


class OOPAOAttachment:
    """faintspot in an OOPAO sensor; see `attach`."""

    def __init__(
        self, wfs: Any, settings: Settings, calibration: Calibration | None, options: SpotOptions
    ) -> None:
        if getattr(wfs, "tag", None) != "shackHartmann":
            raise InputError(f"wfs: expected OOPAO's ShackHartmann, got {type(wfs).__name__}")
        check_version("OOPAO", "oopao", TESTED)
        if wfs.is_geometric:
            raise InputError("wfs.is_geometric = True: expected a diffractive sensor, which has images")
        self.wfs = wfs
        sources = list(wfs.sh_data.values())
        if any(np.any(np.asarray(source.weighting_map) != 1) for source in sources):
            raise InputError(
                'wfs: expected no weighting map, got one; leave it out and use the estimator "window"'
            )
        predict, several = options.get("predict"), len(sources) > 1
        predicts = list(predict) if several and predict is not None else [predict] * len(sources)
        if len(predicts) != len(sources):
            raise InputError(f"predict: expected one for each of {len(sources)} sources, got {len(predicts)}")
        self._sources = [
            _Source(wfs, source, settings, calibration, {**options, "predict": each})
            for source, each in zip(sources, predicts, strict=True)
        ]
        self._current = self._sources[0]
        self._own = wfs.wfs_integrate
        wfs.wfs_integrate, wfs.centroid = self._integrate, self._centroid
        try:
            wfs.initialize_wfs()
            unit = float(wfs.slopes_units)
            if not abs(unit) > _LEAST_UNIT:  # also refuses NaN
                raise InputError(
                    f"wfs.slopes_units: expected about 1 from OOPAO's tilt, got {unit:g}; check "
                    "search_range_px, or give another calibration_flux_e"
                )
        except InputError:
            del wfs.wfs_integrate, wfs.centroid
            raise

    def detach(self) -> None:
        """Restore OOPAO's own centroiding and recalibrate it."""
        del self.wfs.wfs_integrate, self.wfs.centroid
        self.wfs.initialize_wfs()

    @contextmanager
    def calibrating(self, flux_e: float | None = None) -> Iterator[None]:
        """Measure as for calibration in a `with` block; see `ToolSlopes.calibrating`.

        OOPAO's frames without photon and read-out noise are always measured this way.
        """
        with ExitStack() as stack:
            for each in self.measured:
                stack.enter_context(each.calibrating(flux_e))
            yield

    @property
    def measured(self) -> tuple[ToolSlopes, ...]:
        """Measurement of each source, with `last` slopes (px), `standard_errors` and `flux`."""
        return tuple(source.slopes for source in self._sources)

    def recorded(self) -> NDArray[np.float64]:
        """Return the last `wfs.signal` for a recording: NaN where not measured; OOPAO has 0 there."""
        signal = np.ravel(np.asarray(self.wfs.signal, np.float64))
        ends = np.cumsum([2 * len(each.last.measured) for each in self.measured])[:-1]
        parts = zip(self.measured, np.split(signal, ends), strict=True)
        return np.concatenate([each.recorded(part) for each, part in parts])

    def _integrate(self, src: object, sh_data: object) -> object:
        """Run OOPAO's own step, which calls `centroid`, and note its source."""
        self._current = next((s for s in self._sources if s.data is sh_data), self._sources[0])
        return self._own(src, sh_data)

    def _centroid(self, image: object, threshold: float = 0.01) -> NDArray[np.float64]:
        """Return positions as OOPAO does: (n, 2) px from the first pixel, along rows, then along columns."""
        return self._current.positions(image)


class _Source:
    """Sub-apertures of one source."""

    def __init__(
        self, wfs: Any, data: Any, settings: Settings, calibration: Calibration | None, options: SpotOptions
    ) -> None:
        self.wfs, self.data = wfs, data
        self._n, side = int(data.nValidSubaperture), int(wfs.n_pix_subap)
        self._first = 0.5 * (side - 1)
        self._spots = Spots("OOPAO", self._n, side, settings, calibration, rows_first=True, **options)

    @property
    def slopes(self) -> ToolSlopes:
        """Measurement of this source."""
        return self._spots.measured

    def positions(self, image: object) -> NDArray[np.float64]:
        """Return positions; see `OOPAOAttachment._centroid`."""
        images, camera = self._spots.checked(image), self.wfs.cam
        noise_free = not np.any(camera.photonNoise) and not np.any(camera.readoutNoise)
        reference, unit = self._reference() - self._first, float(self.wfs.slopes_units)
        found = self._spots.places(images, reference, unit, noise_free=noise_free)
        return np.ascontiguousarray((found + self._first).T)

    def _reference(self) -> NDArray[np.float64]:
        """Return OOPAO's reference positions, (2, n); the centre before it has any."""
        reference = np.asarray(self.data.reference_signal_2D, np.float64)
        if reference.ndim < 2:
            return np.full((2, self._n), self._first)
        found: NDArray[np.float64] = reference[self.data.valid_signal_2D]
        return found.reshape(2, self._n)
