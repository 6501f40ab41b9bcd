"""Are modes right if the reference is another light, with a layout of its own?

A star fills an annulus of 9 to 13 lenslets, with random Z4 to Z11. The reference lights as many lenslets or
more, up to 1.5 pitches away, with another offset, another flux, or in a frame cut otherwise. Both have the
lenslets' own errors. The commands of docs/guide/wavefront.md give the difference.
"""

import io
import json
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.frames.simulated_arrays import Floats, gaussians
from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.cli import main
from faintspot.slopes.sensor.pupil import lenslet_outlines, pupil_of
from faintspot.slopes.wavefront.zernike import mean_gradients

NUMBER, SEED, FRAMES = 30, 7000, 20
PITCH, WIDTH_PX, LENSLETS_PX, MODES = 20, 1.4, 0.02, 10
KINDS: dict[str, dict[str, Any]] = {
    "same lenslets, up to 1.5 pitches away": {"reach": 1.5, "same": True},
    "more lenslets": {},
    "more lenslets, another offset": {"offset": 420.0},
    "more lenslets, a fifth of the flux": {"flux_e": 1600.0},
    "more lenslets, 0.5 to 1.5 pitches away": {"reach": 1.5, "least": 0.5},
    "more lenslets, frame cut by 17 px": {"cut": 17},
}
"""References, up to 0.45 pitches away along each axis unless stated."""


@dataclass(frozen=True)
class Light:
    """Frames of a source: mean image, offset and size."""

    spots: NDArray[np.complex128]
    flux_e: float = 8000.0
    offset: float = 100.0
    cut: int = 0
    """Rows and columns that the frame lacks at its start."""

    def frames(self, size: int, rng: np.random.Generator) -> Floats:
        """Return frames with photon and read noise."""
        peak = self.flux_e / (2 * np.pi * WIDTH_PX**2)
        image = gaussians((size, size), self.spots, peak, WIDTH_PX)[self.cut :, self.cut :] + 5.0
        noise = rng.normal(self.offset, 3.0, (FRAMES, *image.shape))
        return np.asarray(rng.poisson(image, noise.shape) + noise, np.float32)


def errors_of(
    seed: int, *, reach: float = 0.45, least: float = 0.0, same: bool = False, **light: Any
) -> tuple[Floats, float, float]:
    """Return errors of modes and of tilt modulo a pitch [standard errors], and of the disk's centre [px]."""
    rng = np.random.default_rng(seed)
    across = int(rng.integers(9, 14))
    side = across + 6
    whole = fs.Layout.grid((side, side), pixels=PITCH)
    distance = np.hypot(*(whole.cells - (side - 1) / 2).T)
    lit = (distance < across / 2) & (distance > 1.5)
    star, pupil = whole[lit], pupil_of(whole[lit])
    outlines = (lenslet_outlines(star) - pupil.centre_px) / pupil.radius_px
    true = np.append([0.0, 0.0], rng.normal(0, 1.0, MODES - 2)) / np.arange(2, MODES + 2)
    slopes = np.concatenate(mean_gradients(np.arange(2, MODES + 2), outlines)) @ true
    at = (whole.centres + rng.normal(0, LENSLETS_PX, (len(whole), 2))) @ [1, 1j]
    apart = rng.uniform(least, reach, 2) * rng.choice([-1, 1], 2) * PITCH
    reference = Light(at[lit if same else distance < side] + apart @ [1, 1j], **light)
    lights = {"star": Light(at[lit] + slopes.reshape(2, -1).T @ [1, 1j]), "flat": reference}
    found = _as_a_user({name: light.frames(side * PITCH, rng) for name, light in lights.items()})
    errors = np.array([mode["standard_error"] for mode in found["mean"]["modes"]])
    values = np.array([mode["mean"] for mode in found["mean"]["modes"]])
    radius = found["pupil_radius_subapertures"]
    off_px = (2 * values[:2] / radius + apart - reference.cut + PITCH / 2) % PITCH - PITCH / 2
    tilt = float(np.abs(off_px / (2 * errors[:2] / radius)).max())
    centre = float(np.hypot(*np.subtract(found["pupil_centre_px"], pupil.centre_px)))
    return (np.abs(values - true * radius) / errors)[2:], tilt, centre


def _as_a_user(frames: dict[str, Floats]) -> dict[str, Any]:
    """Return what the commands of the guide write about the frames of a star and a flat wavefront."""
    with tempfile.TemporaryDirectory() as folder:
        files = {name: str(Path(folder, name)) for name in (*frames, "found")}
        for name, values in frames.items():
            file = files[name]
            np.save(f"{file}.npy", values)
            _run("layout", f"{file}.npy", "-o", f"{file}.toml")
            _run("slopes", f"{file}.npy", "-c", f"{file}.toml", "-o", f"{file}.npz")
        found = f"{files['found']}.json"
        minus = "--minus", f"{files['flat']}.npz", "--modes", str(MODES)
        _run("wavefront", f"{files['star']}.npz", *minus, "-o", found)
        return dict(json.loads(Path(found).read_text()))


def _run(*arguments: str) -> None:
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = main(list(arguments))
    if code:
        raise InputError(said.getvalue())


def table(number: int = NUMBER, seed: int = SEED) -> Table:
    """Judge differences from references of every kind."""
    rows = []
    for start, (kind, options) in enumerate(KINDS.items()):
        seeds = range(seed + 1000 * start, seed + 1000 * start + number // len(KINDS))
        judged = [errors_of(each, **options) for each in seeds]
        modes, tilts, centres = (np.array(values) for values in zip(*judged, strict=True))
        values = {
            "differences": float(len(judged)),
            "modes within 3 errors (%)": 100 * float(np.mean(modes < 3)),
            "worst mode (errors)": float(modes.max()),
            "worst tilt (errors)": float(tilts.max()),
            "disk's centre off (px)": float(centres.max()),
        }
        rows.append(Row(kind, values))
    title = f"Z4 to Z{MODES + 1} of {number} stars minus references of another light (seed {seed})"
    return Table("references", title, rows)
