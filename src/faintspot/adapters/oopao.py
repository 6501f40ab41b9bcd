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

TESTED = "1.0.0"
_LEAST_UNIT = 1e-6  # smallest unit of OOPAO's slopes; a tilt of one pixel gives about 1


def attach(
    wfs: object,
    settings: Settings,
    calibration: Calibration | None = None,
    *,
    predict: Any = None,
    **options: Unpack[AdapterOptions],
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
        psf, weights, calibration_flux_e, flux_frames, threads: see `faintspot.adapters.base.ToolSlopes`.

    Returns
    -------
    OOPAOAttachment
        `calibrating`, `measured`, `recorded`; `detach()` restores OOPAO's own centroiding.

    Raises
    ------
    InputError
        When the sensor is of another kind, geometric or has a weighting map, or as for `ToolSlopes`.
    """
    return OOPAOAttachment(wfs, settings, calibration, predict, options)


class OOPAOAttachment:
    """faintspot in an OOPAO sensor; see `attach`."""

    def __init__(
        self,
        wfs: Any,
        settings: Settings,
        calibration: Calibration | None,
        predict: Any,
        options: AdapterOptions,
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
        several = len(sources) > 1 and predict is not None
        predicts = list(predict) if several else [predict] * len(sources)
        if len(predicts) != len(sources):
            raise InputError(f"predict: expected one for each of {len(sources)} sources, got {len(predicts)}")
        self._sources = [
            _Source(wfs, source, each, ToolSlopes(_windows(wfs, source), settings, calibration, **options))
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


def _windows(wfs: Any, source: Any) -> Layout:
    """Return the windows of a source, one below the other."""
    return Layout.stacked(int(source.nValidSubaperture), (int(wfs.n_pix_subap),) * 2)


class _Source:
    """Sub-apertures of one source. Coordinates along rows (y) come before those along columns (x)."""

    def __init__(self, wfs: Any, data: Any, predict: object, slopes: ToolSlopes) -> None:
        self.wfs, self.data, self.slopes, self._predict = wfs, data, slopes, predict
        self._n, self._side = len(slopes.pipeline.layout), slopes.pipeline.layout.window[0]
        self._first = 0.5 * (self._side - 1)
        self._last: NDArray[np.float64] | None = None

    def positions(self, image: object) -> NDArray[np.float64]:
        """Return positions; see `OOPAOAttachment._centroid`."""
        n, side = self._n, self._side
        images, camera = np.asarray(image), self.wfs.cam
        if images.shape != (n, side, side):
            raise InputError(
                f"OOPAO's images: expected shape {(n, side, side)}, got {images.shape}; attach faintspot "
                "again after changing the sensor"
            )
        noise_free = not np.any(camera.photonNoise) and not np.any(camera.readoutNoise)
        noise_free = noise_free or self.slopes.noise_free
        reference, unit, prior = self._reference() - self._first, float(self.wfs.slopes_units), None
        if not noise_free:
            expected = predicted(self._predict, self._last, (2 * n,))
            if expected is not None:
                prior = (expected.reshape(2, n) * unit + reference)[::-1].ravel()
        found = self.slopes.measure(images.reshape(-1, side), prior_px=prior, noise_free=noise_free)[::-1]
        found = np.where(self.slopes.last.measured, found, reference)
        if not noise_free:
            self._last = ((found - reference) / unit).ravel()
        return np.ascontiguousarray((found + self._first).T)

    def _reference(self) -> NDArray[np.float64]:
        """Return OOPAO's reference positions, (2, n); the centre before it has any."""
        reference = np.asarray(self.data.reference_signal_2D, np.float64)
        if reference.ndim < 2:
            return np.full((2, self._n), self._first)
        found: NDArray[np.float64] = reference[self.data.valid_signal_2D]
        return found.reshape(2, self._n)
