"""How large are the systematic errors of the slopes with the settings of `faintspot layout`, by spot width?

`faintspot layout` sees three noisy frames of a regular array of spots. `faintspot slopes` measures frames
without noise, in which all spots are displaced alike by up to 0.95 px. Spots lie at all places in their
pixels, as the pitch is no whole number. The systematic error of a slope is what is left after the mean of its
spot over the displacements, which a reference takes off. The settings are tried on Gaussian spots; Airy and
Moffat spots have other wings.
"""

import contextlib
import io
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from benchmarks.measuring import Row, Table
from faintspot.cli import main
from faintspot.io import read_slopes
from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]

SIDE, SEED, MOST_PX = 8, 4000, 0.03  # lenslets; px
PITCHES_PX, PLACES = (8.0, 16.0), 11
WIDTHS_PX, WIDTHS = (1.0, 1.2, 1.5, 2.0), (0.35, 0.5, 0.6, 0.7)  # px; pitches
FLUX_E, READ_NOISE_E, FRAMES = 1e5, 3.0, 3
_SHARP_PX = 3.0
_SAID = re.compile(r"S-curve: systematic errors up to ([0-9.]+) px")


def _gaussian(radius: Floats, fwhm_px: float) -> Floats:
    return np.asarray(np.exp(-4 * np.log(2) * (radius / fwhm_px) ** 2))


def _airy(radius: Floats, fwhm_px: float) -> Floats:
    angle = np.maximum(3.2326 * radius / fwhm_px, 1e-9)
    return np.asarray((2 * j1(angle) / angle) ** 2)


def _moffat(radius: Floats, fwhm_px: float) -> Floats:
    scale = fwhm_px / (2 * np.sqrt(2 ** (1 / 3) - 1))
    return np.asarray((1 + (radius / scale) ** 2) ** -3.0)


SHAPES: dict[str, Callable[[Floats, float], Floats]] = {
    "Gaussian": _gaussian,
    "Airy": _airy,
    "Moffat (beta 3)": _moffat,
}


def run() -> list[Table]:
    """Measure each shape and width at all pitches."""
    rows, seed = [], SEED
    for shape in SHAPES:
        for widths, unit in ((WIDTHS_PX, "px"), (WIDTHS, "pitches")):
            for width in widths:
                found = []
                for pitch in PITCHES_PX:
                    seed += 1
                    found.append(case(shape, pitch, width * (pitch if unit == "pitches" else 1.0), seed))
                values = {name: max(each[name] for each in found) for name in found[0]}
                fine = values["largest (px)"] < MOST_PX
                rows.append(Row(f"{shape}, FWHM {width:g} {unit}", values, f"< {MOST_PX:g} px", fine))
    note = (
        f"Largest of pitches of {' and '.join(f'{pitch:g}' for pitch in PITCHES_PX)} px, {SIDE} x {SIDE} "
        f"spots of {FLUX_E:g} e-; FWHM without the pixels' blur"
    )
    return [Table("spot_widths", "Systematic errors of slopes by the width of spots", rows, [note])]


def case(shape: str, pitch_px: float, fwhm_px: float, seed: int) -> dict[str, float]:
    """Return the errors of one array of spots."""
    rng = np.random.default_rng(seed)
    pitch = pitch_px + rng.uniform(0.1, 0.2)
    places = np.stack(np.meshgrid(*2 * [np.arange(SIDE)]), -1).reshape(-1, 2) + 1
    nodes: Floats = np.asarray(places * pitch + rng.uniform(0, 1, 2), np.float64)
    moved = np.stack([np.linspace(-1, 1, PLACES), np.arange(PLACES) * 0.764 % 2 - 1], axis=1) * 0.95
    side = int(pitch * (SIDE + 1)) + 2
    flat = _frame(shape, nodes, fwhm_px, side)
    noisy = rng.poisson(flat, (FRAMES, side, side)) + rng.normal(0, READ_NOISE_E, (FRAMES, side, side))
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        np.save("flat.npy", noisy.astype(np.float32))
        images = [_frame(shape, nodes + displacement, fwhm_px, side) for displacement in moved]
        np.save("moved.npy", np.array(images, np.float32))
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
            main(["layout", "flat.npy", "-o", "c.toml"])
            main(["slopes", "moved.npy", "--config", "c.toml", "-o", "slopes.npz"])
        variables = read_slopes(Path("slopes.npz")).variables
        centres = Layout.load(Path("c.toml")).centres
    owner = np.hypot(*(centres[:, None] - nodes).T).argmin(axis=0)
    slopes = np.stack([variables["x"], variables["y"]], axis=-1) + centres - nodes[owner]
    errors = slopes - moved[:, None]
    constant = errors.mean(axis=0)
    systematic = errors - constant
    scale = float(np.sum(systematic * moved[:, None]) / np.sum(np.square(moved[:, None] + 0 * systematic)))
    predicted = _SAID.search(said.getvalue())
    return {
        "rms (px)": float(np.sqrt(np.mean(np.square(systematic)))),
        "largest (px)": float(np.abs(systematic).max()),
        "predicted (px)": float(predicted[1]) if predicted else np.inf,
        "error of the scale (%)": 100 * abs(scale),
        "constant at the edge (px)": float(np.abs(constant - np.median(constant, axis=0)).max()),
        "doubted": float("doubtful" in said.getvalue()),
    }


def _frame(shape: str, centres: Floats, fwhm_px: float, side: int) -> Floats:
    """Return the sum of spots, integrated over the pixels."""
    image = np.zeros((side, side))
    reach = int(2.2 * fwhm_px) + 8
    nodes, of_nodes = np.polynomial.legendre.leggauss(7 if fwhm_px < _SHARP_PX else 3)
    fine = (np.arange(-reach, reach + 1)[:, None] + nodes / 2).ravel()
    weights = np.tile(of_nodes / 2, 2 * reach + 1)
    of_unit = SHAPES[shape](np.hypot(fine[:, None], fine), fwhm_px)
    flux = float(weights @ of_unit @ weights)
    for centre in centres:
        column, row = np.rint(centre).astype(int)
        x, y = (fine + whole - at for whole, at in zip((column, row), centre, strict=True))
        samples = SHAPES[shape](np.hypot(y[:, None], x), fwhm_px) * weights[:, None] * weights
        pixels = samples.reshape(*2 * (2 * reach + 1, len(nodes))).sum(axis=(1, 3))
        rows, columns = (np.clip([at - reach, at + reach + 1], 0, side) for at in (row, column))
        part = pixels[
            rows[0] - row + reach : rows[1] - row + reach,
            columns[0] - column + reach : columns[1] - column + reach,
        ]
        image[rows[0] : rows[1], columns[0] : columns[1]] += FLUX_E / flux * part
    return image
