"""An estimator of one's own, in NumPy: `python examples/own_estimator.py` measures with it.

What imports this file has it by its name, everywhere: configuration files, tune, studies, loops, real time,
reports. An installed package makes it known with an entry point of the group "faintspot.estimators".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

import faintspot as fs
from faintspot.estimators import Estimator, option, register


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class PowerCentroid(Estimator):
    """Centre of gravity of a power of the image: bright pixels count more."""

    power: Any = option(1.5, "Power of each pixel's light.", low=1.0, high=4.0, per_subaperture=False)

    name: ClassVar[str] = "power"
    label: ClassVar[str] = "power centroid"

    def tuned(self, scene: Any) -> dict[str, list[float]]:
        return {"power": [1.5, 1.0, 2.0, 3.0]}

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        weight = np.maximum(images, 0.0) ** self.power
        y, x = np.indices(images.shape[1:]) - (np.array(images.shape[1:])[:, None, None] - 1) / 2
        with np.errstate(invalid="ignore", over="ignore"):
            return np.stack([(weight * x).sum((1, 2)), (weight * y).sum((1, 2))], 1) / weight.sum((1, 2))[:, None]


if __name__ == "__main__":
    images, truth = fs.simulate.subapertures(2000, flux_e=1000, detector=fs.simulate.Detector(read_noise_e=1.0))
    for power in (1.0, 1.5, 2.0, 3.0):
        found = fs.estimators.measure(images, fs.Settings("power", power=power))
        print(f"power {power}: R {np.abs(np.column_stack([found.x, found.y]) - truth).mean():.3f} px")
