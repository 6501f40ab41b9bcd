"""
Which settings for my camera and star?
======================================

`faintspot tune` simulates your spots and compares every estimator, tuned on other spots than those that
score. This is the same from Python.
"""

# %%
# A sensor of 0.6 m lenslets with a camera of 3 electrons, at 500 frames a second; a star of magnitude 10;
# seeing with r0 of 0.12 m. Replace them by your own numbers.

import numpy as np

import faintspot as fs
from faintspot.experiments import Question

question = Question(
    read_noise_e=3.0,
    pixels=10,
    pixel_scale_arcsec=0.25,
    subaperture_m=0.6,
    wavelength_nm=650.0,
    r0_m=0.12,
    frame_rate_hz=500.0,
    magnitude=10.0,
)
answer = fs.tune(question, rng=np.random.default_rng(1), realisations=1000)
print(f"{answer.best.method.label}: R = {answer.best.error_px[answer.at_star]:.3f} px")
print(answer.best.settings)

# %%
# The slope error of every estimator against magnitude, with the limit that the photons set (Cramer-Rao),
# and where a small change of magnitude changes the choice:

figure = fs.experiments.tune_figure(answer)

# %%
# `answer.save("faintspot.toml")` writes what `faintspot slopes` and `SlopePipeline.from_file` read. For a
# closed loop, where a slope error is only part of the story, ask `faintspot loop magnitude`.
