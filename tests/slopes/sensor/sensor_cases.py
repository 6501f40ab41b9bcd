"""Frames of simulated sensors: what is known about each is chosen, not found."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.slopes.sensor.detection.lenslets import LensletGrid
from faintspot.slopes.simulate import Detector, sensor_frames

RATIOS = {"square": 1j, "hexagonal": np.exp(1j * np.pi / 3)}
"""Second step of a lattice over the first."""


@dataclass
class Windows:
    """Windows that may overlap, unlike those of a `Layout`."""

    corners: np.ndarray
    window: tuple[int, int]
    frame_shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.corners)


def lattice(shape: tuple[int, int], pitch_px: float, start: tuple[float, float]) -> NDArray[np.complex128]:
    """Return the nodes x + 1j * y of a square lattice, row by row."""
    row, column = np.indices(shape).reshape(2, -1)
    return np.asarray(complex(*start) + pitch_px * (column + 1j * row), np.complex128)


def spot_frame(
    nodes: NDArray[Any],
    shape: tuple[int, int],
    *,
    flux_e: ArrayLike,
    spread_px: float = 0.0,
    width_px: float = 1.2,
    seed: int = 1,
    **detector: Any,
) -> NDArray[Any]:
    """Return a frame of Gaussian spots scattered about nodes x + 1j * y (n,), in ADU.

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
        1,
        flux_e=flux_e,
        profile="gaussian",
        size=width_px * 1.1774,  # its full width at half maximum is 2 px times the size
        positions=wanted[np.newaxis],
        detector=Detector(**options),
        rng=rng,
    )
    return np.asarray(frames[0, margin:-margin, margin:-margin], np.float64)


class Sensor:
    """An annular pupil on a lattice that fills the frame, and one frame of it."""

    def __init__(
        self,
        seed: int,
        *,
        geometry: str = "square",
        pitch_px: float = 20.0,
        angle_deg: float | None = None,
        lenslets: int = 12,
        inner: float = 0.3,
        spider: float = 0.0,
        flux_e: float = 2000.0,
        scatter: float = 0.15,
        outside: float = 0.0,
        width: float = 0.07,
        background_e: float = 20.0,
        haze_e: float = 0.0,
        hot_pixels: int = 0,
        **detector: Any,
    ) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.size = size = int((lenslets + 3) * pitch_px)
        self.pitch_px, self.geometry, self.lenslets = pitch_px, geometry, lenslets
        drawn_deg = rng.uniform(-20, 20)
        self.angle_deg = drawn_deg if angle_deg is None else angle_deg
        step = pitch_px * np.exp(1j * np.radians(self.angle_deg))
        count = np.arange(-2 * lenslets, 2 * lenslets + 1)
        grid = count + count[:, None] * RATIOS[geometry]
        offset = step * (grid.ravel() + rng.uniform(-0.5, 0.5) + 1j * rng.uniform(-0.5, 0.5))
        nodes = offset + (1 + 1j) * (size - 1) / 2
        seen = (np.minimum(nodes.real, nodes.imag) > 2) & (np.maximum(nodes.real, nodes.imag) < size - 3)
        offset, self.nodes = offset[seen], nodes[seen]
        radius = np.abs(offset) / (pitch_px * lenslets / 2)
        self.illuminated = (radius < 1) & (radius > inner)
        self.illuminated &= np.minimum(np.abs(offset.real), np.abs(offset.imag)) >= spider * pitch_px
        self.flux_e = flux_e * np.exp(scatter * rng.standard_normal(len(radius)))
        self.flux_e[~self.illuminated] *= outside
        self.width_px = max(width * pitch_px, 0.8)
        margin = 2 * int(np.ceil(4 * self.width_px)) + 2
        y, x = np.mgrid[-margin : size + margin, -margin : size + margin] - size / 2
        self.background_e = background_e + haze_e * np.exp(-2 * (x**2 + y**2) / (pitch_px * lenslets) ** 2)
        self.hot_pixels = hot_pixels
        self.detector = detector
        self.seed = seed

    def frame(self) -> NDArray[np.float64]:
        image = spot_frame(
            self.nodes,
            (self.size, self.size),
            flux_e=self.flux_e,
            spread_px=0.06 * self.pitch_px,
            width_px=self.width_px,
            seed=self.seed,
            background_e=self.background_e,
            **self.detector,
        )
        row, column = self.rng.integers(0, self.size, (2, self.hot_pixels))
        image[row, column] += self.rng.uniform(50, 3000, self.hot_pixels)
        return np.asarray(image)

    def wrong(self, grid: LensletGrid) -> tuple[int, int]:
        """Return how many lit lenslets are missing, and how many found ones are not lit."""
        near = self._distances(grid) < 0.3
        return int(np.count_nonzero(~near.any(axis=0))), int(np.count_nonzero(~near.any(axis=1)))

    def errors(self, grid: LensletGrid) -> NDArray[np.float64]:
        """Return the distances of found nodes from those of lit lenslets, pitches."""
        nearest = self._distances(grid).min(axis=1)
        return np.asarray(nearest[nearest < 0.3])

    def _distances(self, grid: LensletGrid) -> NDArray[np.float64]:
        found = grid.centres @ [1, 1j]
        return np.asarray(np.abs(found[:, None] - self.nodes[self.illuminated]) / self.pitch_px)


def check_regular(grid: LensletGrid) -> None:
    """The centres are the lattice that the pitch, the angle and the cells say."""
    step = grid.pitch_px * np.exp(1j * np.radians(grid.angle_deg))
    nodes = step * (grid.cells[:, 1] + grid.cells[:, 0] * RATIOS[grid.geometry])
    origin = grid.centres[:, 0] + 1j * grid.centres[:, 1] - nodes
    np.testing.assert_allclose(origin, origin[0], atol=1e-6)
    assert grid.cells.min(axis=0).tolist() == [0, 0]
    assert np.array_equal(np.lexsort((grid.cells[:, 1], grid.cells[:, 0])), np.arange(len(grid.cells)))
    half_turn = 45 if grid.geometry == "square" else 30
    assert -half_turn <= grid.angle_deg < half_turn
    assert len(grid.flux) == len(grid.centres) == len(grid.cells)
