"""What the tests of the experiments share."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from faintspot.slopes.estimators import Estimator, Need, Scene, Sensor, option, registry


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnEstimator(Estimator):
    """Of another package, in plain NumPy: the centre of gravity of a power of the pixels."""

    power: Any = option(1.0, "Of the pixels.", low=1.0, high=9.0, per_subaperture=False)
    name: ClassVar[str] = "own"
    label: ClassVar[str] = "somebody's own"
    needs: ClassVar[frozenset[Need]] = frozenset({Need.WIDTH})

    def tuned(self, scene: Scene) -> dict[str, list[float]]:
        return {"power": [1.0, 2.0]}

    def locate(self, images: Any, sensor: Sensor, prior: Any) -> Any:
        assert np.isfinite(sensor.spot_fwhm_px).all()
        flux = np.maximum(images, 0.0) ** self.power
        y, x = (np.arange(size) - (size - 1) / 2 for size in images.shape[1:])
        total = flux.sum(axis=(1, 2))
        return np.stack([flux.sum(axis=1) @ x / total, flux.sum(axis=2) @ y / total], axis=1)


@pytest.fixture
def own_estimator(monkeypatch: pytest.MonkeyPatch) -> type[Estimator]:
    """Let there be an estimator "own" for as long as a test lasts."""
    monkeypatch.setattr(registry, "_kinds", {**registry.estimators(), "own": OwnEstimator})
    return OwnEstimator
