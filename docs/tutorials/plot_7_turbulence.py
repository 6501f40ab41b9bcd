"""
The turbulence of your night, from frames
=========================================

From a movie of spots to r0, outer scale, coherence time and winds in three commands. The movie is simulated
here, so that the results can be compared with the truth; with frames of your own, begin at the commands.
"""

# %%
# A movie
# -------
# Simulated: a star seen by 7 x 7 sub-apertures of 0.6 m without a loop, four layers of frozen turbulence, 12
# seconds at 250 frames/s. r0 rises slowly. The camera adds a margin, 100 ADU, photon noise and 1 electron of
# read noise to 200 electrons a spot. Not simulated: vibrations, dome seeing, and winds that change.

import csv
import json
import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

from faintspot.loop.simulation import load_loop
from faintspot.loop.simulation.telescope import TelescopeModel
from faintspot.slopes.simulate import Detector

RATE_HZ, FRAMES = 250.0, 3000
site = load_loop("open_loop").replace("sensor", pixels=12)
site = site.replace("atmosphere", r0_m=(0.2, 0.3), drift_time_s=24.0)
telescope = TelescopeModel(site, seed=1, noiseless=True)
camera = Detector(1.0, offset_adu=100.0, bits=12)
rng, still = np.random.default_rng(1), np.zeros(telescope.optics.mirror.commands)

movie = np.zeros((FRAMES, 100, 100), np.uint16)
for number in range(FRAMES):
    _, seen_nm = telescope.wavefronts((number + 0.5) / RATE_HZ, still)
    movie[number] = camera.expose(np.pad(telescope.frame(number, seen_nm), 8), rng)

temporary = TemporaryDirectory()
folder = Path(temporary.name)
np.save(folder / "night.npy", movie)

# %%
# One frame, and the mean of all. Between frames the spots move and break up, which is the measurement.

figure = Figure(figsize=(9, 4.2), layout="constrained")
for axes, (title, image) in zip(
    figure.subplots(1, 2), {"one frame": movie[0], "mean": movie.mean(axis=0)}.items(), strict=True
):
    shown = axes.imshow(image, cmap="cividis", origin="lower")
    axes.set(title=title, xlabel="column, px", ylabel="row, px")
    figure.colorbar(shown, label="ADU", shrink=0.8)

# %%
# Three commands
# --------------
# `faintspot layout` finds lenslets and settings from the frames. Pixel scale and the side of a lenslet in the
# pupil are yours: they give slopes their unit.


def faintspot(command: str) -> None:
    """Run a command in the folder of the movie, and print its output."""
    words = [sys.executable, "-m", "faintspot", *shlex.split(command)]
    print(subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout)


faintspot("layout night.npy --pixel-scale-arcsec 0.1117 --subaperture-m 0.6")

# %%
# Look at ``faintspot.png`` before going on: all lenslets are found. The dark is the frame's background here;
# give ``--dark`` and ``--gain-e-per-adu`` where you have them.

faintspot("slopes night.npy --config faintspot.toml -o slopes.zarr")

# %%
# The last command needs the frame rate. `--every` asks for the turbulence of each piece as well: 3 s here,
# a minute on the sky.

faintspot("telemetry slopes.zarr --frame-rate-hz 250 --every 3")

# %%
# Results
# -------
# ``slopes.html`` is the page; ``slopes.json`` holds the same numbers with 95 % intervals.

results = json.loads((folder / "slopes.json").read_text())
found = {value["name"]: value for value in results["turbulence"]["known"]}
for name in (
    "r0 at 500 nm",
    "r0 at 500 nm from differential image motion",
    "outer scale",
    "seeing at 500 nm",
    "coherence time at 500 nm",
):
    value = found[name]
    print(f"{name}: {value['value']:.3g} {value['unit']} ({value['low']:.3g} to {value['high']:.3g})")

# %%
# Each layer has a speed, a direction and a share of the turbulence. Crosses are the simulated winds. Layers
# with the same wind count as one, and the height of a layer is unknown.

truth = site.atmosphere
figure = Figure(figsize=(5.2, 5), layout="constrained")
axes = figure.add_subplot(projection="polar")
for layer in range(1, 5):
    speed, angle_deg, share = (
        found[f"layer {layer}: {name}"]["value"] for name in ("speed", "direction", "share")
    )
    axes.scatter(np.radians(angle_deg), speed, 900 * share, color="#4477aa", alpha=0.6)
    axes.annotate(f"{share:.0%}", (np.radians(angle_deg), speed), xytext=(12, 8), textcoords="offset points")
axes.plot(np.radians(truth.wind_direction_deg), truth.wind_speed_m_per_s, "kx")
axes.set_title("winds, m/s")

# %%
# Against time
# ------------
# ``slopes-over-time.csv`` has a row for each piece, with standard errors.

with (folder / "slopes-over-time.csv").open() as file:
    rows = list(csv.DictReader(file))
middle = np.array([float(row["start_s"]) + float(row["duration_s"]) / 2 for row in rows])
times = np.linspace(0, FRAMES / RATE_HZ, 100)
figure = Figure(figsize=(7, 3.6), layout="constrained")
axes = figure.add_subplot(xlabel="time, s", ylabel="r0 at 500 nm, m", ylim=(0, 0.45))
axes.plot(times, [telescope.atmosphere.r0_m(time) for time in times], color="black", label="true")
for shift, name, label in (
    (-0.1, "r0 at 500 nm (m)", "likelihood"),
    (0.1, "r0 at 500 nm from differential image motion (m)", "differential image motion"),
):
    r0, error = (np.array([float(row[column]) for row in rows]) for column in (name, f"error of {name}"))
    axes.errorbar(middle + shift, r0, 1.96 * error, fmt="o", capsize=3, label=label)
axes.legend(loc="lower right", frameon=False)

# %%
# Both estimates follow the rise and agree with each other. What crosses the pupil within 3 s is a small
# sample of the turbulence, as the intervals say. What else limits r0, and the accuracy on frames of other
# simulators: :doc:`/guide/turbulence`.
