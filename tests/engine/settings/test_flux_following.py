"""Mean flux of an engine's frames."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot.engine.settings.following import FluxFollower
from faintspot.slopes.pipeline.light import MeanFlux


def test_the_mean_is_that_of_all_frames_and_then_of_the_latest() -> None:
    """Each frame then counts 1 - 1 / T as much as the next, with a time constant of T = 120 frames."""
    seen: list[MeanFlux] = []
    pipeline: Any = SimpleNamespace(settings=fs.Settings("map"))

    def with_flux(light: MeanFlux) -> Any:
        seen.append(light)
        return pipeline

    pipeline.with_flux = with_flux
    live: Any = SimpleNamespace(running=SimpleNamespace(layout=range(2), pipelines=[pipeline]))
    follower = FluxFollower(live, 120.0)
    flux = np.random.default_rng(1).uniform(50.0, 150.0, (300, 2)).astype(np.float32)
    for frame in flux[:99]:
        follower.take(frame)
    assert (follower.step(), seen) == (False, [])  # too few
    for frame in flux[99:120]:
        follower.take(frame)
    follower.take(np.array([np.nan, np.inf], np.float32))
    assert not follower.step()
    np.testing.assert_allclose(seen[-1].flux_e, flux[:120].mean(axis=0))
    for frame in flux[120:]:
        follower.take(frame)
    follower.step()
    left = (1 - 1 / 120) ** np.arange(180)[::-1]
    expected = flux[120:].T @ left / 120 + flux[:120].mean(axis=0) * (1 - 1 / 120) ** 180
    np.testing.assert_allclose(seen[-1].flux_e, expected)
    assert seen[-1].time_constant_frames == pytest.approx(120.0)
