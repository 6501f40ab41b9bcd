"""A recorded loop whose turbulence, noise, delay and gain are known."""

from functools import lru_cache
from typing import Any

import numpy as np
from tests.loop.control.frozen_flow import closed_loop, frozen_slopes

from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import ARCSEC, SlopeTurbulence

RATE_HZ, NOISE_PX, LOOP_GAIN = 250.0, 0.3, 0.35
CELLS = np.argwhere(np.ones((5, 5)))
CORNERS = np.argwhere(np.ones((6, 6)))
AIR = SlopeTurbulence(
    np.asarray(CELLS[:, ::-1] * 0.6, np.float64),
    0.6,
    0.2 * ARCSEC,
    0.2,
    25.0,
    np.array([0.7, 0.3]),
    np.array([[8.0, 3.0], [-6.0, 14.0]]),
)


@lru_cache(maxsize=4)
def recorded(delay: int = 2, centroid_gain: float = 1.0, frames: int = 2600) -> Recording:
    """Return a loop of an integrator; slopes are bilinear between corners of the sub-apertures."""
    rng = np.random.default_rng(7)
    atmosphere = frozen_slopes(AIR, frames, RATE_HZ, rng)
    apart = CORNERS - CELLS[:, None]
    inside = ((apart == 0) | (apart == 1)).all(axis=2)
    interaction = np.vstack([inside * (apart[..., axis] - 0.5) for axis in (1, 0)])
    matrix = make_reconstructor(interaction).matrix
    noise = NOISE_PX * rng.standard_normal(atmosphere.shape)
    gains: Any = {"loop_gain": LOOP_GAIN, "seen": centroid_gain, "delay": delay}
    slopes, commands = closed_loop(atmosphere, noise, interaction, matrix, **gains)
    known: dict[str, Any] = {"subaperture_m": 0.6, "pixel_scale_arcsec": 0.2, "slope_unit": "px"}
    known |= {"frame": np.arange(50, frames), "name": "case"}
    return Recording(slopes[50:], commands[50:], interaction, CELLS, RATE_HZ, **known)
