"""An estimator of one's own, in NumPy: what imports this file has it by its name, "power", everywhere.

A package makes it known with an entry point of the group "faintspot.estimators".
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import faintspot as fs
from faintspot.slopes.estimators import Estimator, option, register


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class PowerCentroid(Estimator):
    """Centre of gravity of a power of the image: bright pixels count more."""

    power: Any = option(1.5, "Power of each pixel's light.", low=1.0, high=4.0, per_subaperture=False)
    name = "power"
    label = "power centroid"

    def tuned(self, scene: Any) -> dict[str, list[float]]:
        """Return what a planner, a study or a loop may choose from."""
        return {"power": [1.5, 1.0, 2.0, 3.0]}

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        """Return positions (n, 2) of images (n, ny, nx), px from the windows' middles."""
        weight = np.clip(images, 0.0, 1e9) ** self.power
        y, x = (np.arange(n) - (n - 1) / 2 for n in images.shape[1:])
        moments = np.stack([weight.sum(1) @ x, weight.sum(2) @ y], axis=1)
        return moments / np.maximum(weight.sum((1, 2)), 1e-9)[:, None]


if __name__ == "__main__":
    images, truth = fs.slopes.simulate.subapertures(
        2000, flux_e=1000, detector=fs.slopes.simulate.Detector(read_noise_e=1.0)
    )
    found = fs.measure_images(images, fs.Settings("power", power=2.0))
    print(f"R = {np.abs(np.column_stack([found.x, found.y]) - truth).mean():.3f} px")
