"""Figure 1 of the paper: a Shack-Hartmann image without noise, with noise and after TV; and one spot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.estimate.noise import suggested_strength
from faintspot.estimate.total_variation import tv_denoise
from faintspot.report.drawing import WIDTH, colour_bar, new_figure, styled
from faintspot.report.figure_data import FigureWithData
from faintspot.sensor.layout import Layout
from faintspot.simulate import Detector, spots

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FLUX_E = 200.0
READ_NOISE_E = 3.0
POSITION_RANGE_PX = 1.0
_SEED = 1503
_NAMES = ("without noise", "with photon and read noise", "after TV")


def triple_images() -> tuple[Layout, list[NDArray[np.float64]]]:
    """Return a 7 x 7 sensor and its sub-aperture images without noise, with noise and denoised, e-."""
    layout = Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
    rng = np.random.default_rng(_SEED)
    positions = rng.uniform(-POSITION_RANGE_PX, POSITION_RANGE_PX, (len(layout), 2))
    clean = spots(positions, shape=layout.window, flux_e=FLUX_E)
    noisy = Detector(read_noise_e=READ_NOISE_E).expose(clean, rng).astype(np.float64)
    denoised = tv_denoise(noisy, suggested_strength(READ_NOISE_E, FLUX_E, layout.pixels))
    return layout, [clean, noisy, denoised]


@styled
def triple_picture() -> FigureWithData:
    """Draw the sensor in three states, and one of its spots below each."""
    layout, images = triple_images()
    shown = len(layout) // 2
    figure = new_figure(WIDTH, 9.4)
    axes = figure.subplots(2, 3)
    brightest = float(np.percentile(images[1], 99.9))
    for column, (name, stack) in enumerate(zip(_NAMES, images, strict=True)):
        frame = np.full(layout.frame_shape, np.nan)
        for (row, left), image in zip(layout.corners, stack, strict=True):
            frame[row : row + layout.window[0], left : left + layout.window[1]] = image
        whole = _show(axes[0, column], frame, brightest, f"sensor, {name}")
        spot = _show(axes[1, column], stack[shown], brightest, f"one spot, {name}")
    colour_bar(list(axes[0]), whole, "signal (e- per pixel)")
    colour_bar(list(axes[1]), spot, "signal (e- per pixel)")
    caption = (
        f"Simulated for this page, the same at every run: diffraction spots of size 1, {FLUX_E:g} e- each, "
        f"{READ_NOISE_E:g} e- read noise, 16 × 16 px, positions within ±{POSITION_RANGE_PX:g} px. One colour "
        "scale in all six. The data are the spot’s pixels."
    )
    rows = [
        [y, x, *(f"{stack[shown, y, x]:.6g}" for stack in images)]
        for y in range(layout.window[0])
        for x in range(layout.window[1])
    ]
    title = "Figure 1: a sensor without noise, with noise, and after TV"
    header = ["row", "column", "without_noise_e", "noisy_e", "denoised_e"]
    return FigureWithData("fig1", title, caption, figure, header, rows)


def _show(panel: Axes, image: NDArray[np.float64], brightest: float, title: str) -> object:
    shown = panel.imshow(image, vmin=0.0, vmax=brightest, interpolation="nearest")
    panel.set_title(title, fontsize=12)
    panel.set_xlabel("column (px)")
    panel.set_ylabel("row (px)")
    return shown
