"""The shortest use from Python, on simulated frames; draws what every step does."""

import sys

import numpy as np
from matplotlib.figure import Figure

import faintspot as fs

# A sensor of 36 sub-apertures and a few noisy frames with known spot positions.
layout = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
frames, truth = fs.slopes.simulate.sensor_frames(
    layout,
    500,
    flux_e=200,
    detector=fs.slopes.simulate.Detector(read_noise_e=3.0),
    rng=np.random.default_rng(1),
)

# Frames in, slopes out.
pipeline = fs.SlopePipeline(layout, fs.Settings(noise_std=3.0, keep_brightest=9))
slopes = pipeline(frames)
plain = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=7))(frames)
for name, result in (("TV", slopes), ("no TV", plain)):
    error = np.abs(np.stack([result.x, result.y], axis=-1) - truth).mean()
    print(f"{name}: slope error R = {error:.4f} px")

# The images after every step.
stages = pipeline.explain(frames[0])
steps = {
    "calibrated": stages.calibrated,
    "denoised": stages.denoised,
    "after background": stages.background_subtracted,
}
figure = Figure(figsize=(12, 4.4), layout="constrained", dpi=110)
for axes, (step, images) in zip(figure.subplots(1, 3), steps.items(), strict=True):
    sensor = np.full(layout.frame_shape, np.nan)
    for (row, column), image in zip(layout.corners, images, strict=True):
        sensor[row : row + 16, column : column + 16] = image
    shown = axes.imshow(sensor, cmap="cividis", vmin=-5, vmax=35, origin="lower")
    axes.set_title(step)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_frame_on(False)
figure.colorbar(shown, ax=figure.axes, label="e- per pixel", shrink=0.85)
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "steps.png")
