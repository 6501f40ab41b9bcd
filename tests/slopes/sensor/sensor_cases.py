"""Frames of simulated sensors: what is known about each is chosen, not found."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.slopes.simulate import Detector, sensor_frames


@dataclass
class Windows:
    """Windows that may overlap, unlike those of a `Layout`."""

    corners: np.ndarray
    window: tuple[int, int]
    frame_shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.corners)


def spot_frame(
    nodes: NDArray[np.complex128],
    shape: tuple[int, int],
    *,
    flux_e: ArrayLike,
    spread_px: float = 0.0,
    width_px: float = 1.2,
    seed: int = 1,
    n_frames: int = 1,
    **detector: Any,
) -> NDArray[Any]:
    """Return the mean frame of Gaussian spots scattered about nodes x + 1j * y (n,), in ADU.

    Spots (of one flux or n, of this standard deviation) may lie at the frame's edge, which cuts them. The
    detector has 3 e- of read noise unless its options say otherwise.
    """
    rng = np.random.default_rng(seed)
    nodes = nodes + spread_px * (rng.standard_normal(len(nodes)) + 1j * rng.standard_normal(len(nodes)))
    side = 2 * int(np.ceil(4 * width_px)) + 1
    margin = side + 1
    corners = np.stack([np.rint(nodes.imag), np.rint(nodes.real)], axis=1).astype(int) - side // 2 + margin
    wanted = np.stack([nodes.real - np.rint(nodes.real), nodes.imag - np.rint(nodes.imag)], axis=1)
    options = {"read_noise_e": 3.0, "bits": 16, "offset_adu": 100.0, **detector}
    windows: Any = Windows(corners, (side, side), (shape[0] + 2 * margin, shape[1] + 2 * margin))
    frames, _ = sensor_frames(
        windows,
        n_frames,
        flux_e=flux_e,
        profile="gaussian",
        size=width_px * 1.1774,  # its full width at half maximum is 2 px times the size
        positions=np.tile(wanted, (n_frames, 1, 1)),
        detector=Detector(**options),
        rng=rng,
    )
    return np.asarray(frames[:, margin:-margin, margin:-margin].mean(axis=0))
