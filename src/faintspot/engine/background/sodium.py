"""Following a sodium layer beside a running engine: a separate process fits the profile to its frames.

The engine loses no time with it: the process has the lowest priority and one thread, reads the images that
telemetry keeps, and makes the spots; the engine prepares them in another thread than that which measures. If
the process ends or hangs, the engine goes on with the last profile.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.validity import are_valid
from faintspot.engine.background.background_process import BackgroundProcess, background_process
from faintspot.engine.engine import Engine
from faintspot.loop.control.configuration import load_control
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.spots.laser_spots import matched_filter
from faintspot.slopes.spots.sodium import SodiumProfile
from faintspot.slopes.training.known_sodium import KnownSodium, calibrated_images, dark_variance_e2
from faintspot.slopes.training.sodium import MeanImages

Floats = NDArray[np.float64]

_FEWEST_IMAGES = 20
_LEAST_VALID = 0.5  # of the sub-apertures
_SPOT_EVERY = 20  # fits: the width of the spot changes with the seeing
_LEAST_CHANGE = 0.02  # of the flux at other altitudes
_LEAST_FLUX_CHANGE = 0.2


class SodiumFollower(BackgroundProcess):
    """Follower of the sodium layer that a running engine's laser guide star shows.

    Parameters
    ----------
    name : str
        Name of the engine.
    config : path
        Configuration of the engine, with [laser].

    Raises
    ------
    InputError
        When the configuration has no laser that is followed, the layout no angles, or there is no engine.
    """

    look_s = 0.1  # the ring keeps 2 to 16 images
    patience_s = 120.0
    failed = "not followed"

    def __init__(self, name: str, config: str | Path) -> None:
        described = Configuration(config)
        laser = described.laser
        if laser is None or not laser.follow_every_s:
            raise InputError(f"{config}: expected [laser] with follow_every_s > 0, to follow its profile")
        self._laser = laser
        self._layout, self._calibration = described.layout, described.calibration
        self._star = laser.star_of(self._layout)
        self._dark = dark_variance_e2(self._layout, self._calibration)
        self._profile: SodiumProfile = self._star.focused(laser.profile)
        control = load_control(described)
        reference = np.zeros((2, len(self._layout)))
        if control is not None and control.reference is not None:
            reference = np.reshape(control.reference, reference.shape)
        self._zero = self._layout.offsets + reference.T
        super().__init__(name)
        self._cursors = [self._reader.records.written, self._reader.images.written]
        self._mean: MeanImages | None = None
        self._sodium: KnownSodium | None = None
        self._in_use: KnownSodium | None = None
        self._fits, self._count, self._times_s = 0, 0, [0.0, 0.0]
        self._due_s = time.monotonic() + laser.follow_every_s

    def take(self) -> bool:
        """Take the images that have come into the running mean; return whether a fit is due."""
        images, self._cursors[1], _ = self._reader.images.since(self._cursors[1])
        records, self._cursors[0], _ = self._reader.records.since(self._cursors[0])
        row_of = {int(frame): row for row, frame in enumerate(records["frame"])}
        for image in images:
            row = row_of.get(int(image["image_frame"]))
            if row is not None:
                self._add(image["raw"], records[row])
        return self._count >= _FEWEST_IMAGES and time.monotonic() >= self._due_s

    def _add(self, raw: NDArray[np.float32], record: NDArray[np.void]) -> None:
        """Add an image and its slopes to the running mean."""
        valid = are_valid(record["flags"])
        if valid.mean() < _LEAST_VALID:
            return
        electrons, _ = calibrated_images(raw, self._layout, self._calibration)
        slopes = np.stack([record["x"], record["y"]], axis=1).astype(np.float64)
        slopes[~valid] = 0.0
        self._times_s[1] = float(record["last_row_time_ns"]) / 1e9
        if self._mean is None:
            self._mean, self._times_s[0] = MeanImages(electrons, slopes + self._zero), self._times_s[1]
        else:
            elapsed = max(self._times_s[1] - self._times_s[0], 1e-6)
            within = self._laser.follow_time_constant_s * self._count / elapsed
            self._mean = replace(self._mean, time_constant_frames=max(within, 1.0))
            self._mean = self._mean.updated(electrons, slopes + self._zero)
        self._count += 1

    def fit(self) -> KnownSodium:
        """Fit the profile to the running mean, and from time to time the width of the spot.

        Raises
        ------
        InputError
            When the images show no spots that a profile fits.
        """
        assert self._mean is not None
        self._due_s = time.monotonic() + self._laser.follow_every_s
        if self._sodium is None or self._fits % _SPOT_EVERY == 0:
            self._sodium = KnownSodium.learnt(self._mean, self._star, self._profile, self._dark)
        else:
            self._sodium = self._sodium.updated(self._mean)
        self._fits += 1
        self._profile = self._sodium.fit.profile
        return self._sodium

    def answer(self) -> str | None:
        """See `BackgroundProcess`: fit the profile, and hand it over if it is new."""
        sodium = self.fit()
        if not self.is_new(sodium):
            return None
        frame = self.hand_over(sodium)
        return f"{sodium.fit.profile}, spot {sodium.spot_fwhm_arcsec:.2f} arcsec, from frame {frame} on"

    def is_new(self, sodium: KnownSodium) -> bool:
        """Return whether profile, spot or flux differ from what the engine has."""
        last = self._in_use
        if last is None:
            return True
        flux, before = sodium.fit.flux_e, np.maximum(last.fit.flux_e, 1e-3)
        return (
            sodium.star is not last.star
            or moved_part(sodium.fit.profile, last.fit.profile) > _LEAST_CHANGE
            or float(np.median(np.abs(flux / before - 1.0))) > _LEAST_FLUX_CHANGE
        )

    def hand_over(self, sodium: KnownSodium) -> int | None:
        """Give the engine the spots of a profile; return the first frame measured with them.

        Raises
        ------
        InputError
            When the engine refuses them, or does not answer.
        """
        before = self._star.focused(self._laser.profile) if self._in_use is None else self._in_use.fit.profile
        psf = sodium.psf(self._layout.window)
        score = None
        if self._laser.matched_filter:
            flux = np.maximum(sodium.fit.flux_e, 1.0)
            score = matched_filter(psf, self._layout, self._calibration, flux)
        answer = self.tell("spots", {"psf": psf, "score": score}, sodium=_as_values(sodium, before))
        self._in_use = sodium
        frame: int | None = answer["frame"]
        return frame


def moved_part(profile: SodiumProfile, earlier: SodiumProfile) -> float:
    """Return the part of the flux that comes from other altitudes than in another profile."""
    altitudes = np.union1d(profile.altitudes_m, earlier.altitudes_m)
    density, before = (
        np.interp(altitudes, layer.altitudes_m, layer.density, 0.0, 0.0) for layer in (profile, earlier)
    )
    return 0.5 * float(np.trapezoid(np.abs(density - before), altitudes))


def _as_values(sodium: KnownSodium, before: SodiumProfile) -> dict[str, Any]:
    """Return a profile and the one before as plain values: altitudes [km], flux per km."""
    profile = sodium.fit.profile
    earlier = np.interp(profile.altitudes_m, before.altitudes_m, before.density, 0.0, 0.0)
    return {
        "mean_km": round(profile.mean_m / 1e3, 2),
        "std_km": round(profile.std_m / 1e3, 2),
        "spot_fwhm_arcsec": round(sodium.spot_fwhm_arcsec, 3),
        "altitude_km": (profile.altitudes_m / 1e3).round(3).tolist(),
        "flux_per_km": (1e3 * profile.density).round(5).tolist(),
        "before_per_km": (1e3 * earlier).round(5).tolist(),
    }


@contextmanager
def background_sodium(engine: Engine, config: str | Path, say: Callable[[str], None]) -> Iterator[None]:
    """Run the process that follows the profile within a context; `say` takes a line if it ends."""

    def fault(text: str) -> None:
        engine.sodium = {**(engine.sodium or {}), "fault": text}
        say(f"the sodium profile is not followed, the engine goes on with the last one: {text}")

    with background_process("follow", ("--config", f"{config}", "--name", engine.name), fault):
        yield
