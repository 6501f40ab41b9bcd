"""Whether spots that leave their windows keep their identity: `SpotFollower` on simulated recordings.

Random wavefronts (Zernike modes of Noll 2 to 21, weaker for higher orders) grow from 0 to the stated largest
displacement, in random round pupils with and without a hole. 3 % of the lenslets have no spot, and all spots
move together by 0.02 pitches from frame to frame. A valid slope is wrong if it is off by more than a quarter
of the pitch, or if its lenslet has no spot.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table
from faintspot.slopes.sensor.pupil import lenslet_outlines
from faintspot.slopes.wavefront.zernike import mean_gradients, noll_to_nm

SEEDS = range(1000, 1010)
"""Others than those with which the limits of `SpotFollower` were chosen (0 to 30)."""
WRONG, MOST_WRONG = 0.25, 0.01
_MODES = range(2, 22)


@dataclass(frozen=True)
class Case:
    """Parameters of recordings; lengths in pixels unless they are in pitches."""

    across: int = 9
    geometry: str = "square"
    pitch_px: int = 20
    flux_e: float = 3000.0
    read_noise_e: float = 3.0
    fwhm_px: float = 3.0
    frames: int = 40
    pitches: float = 1.5
    """Largest displacement in the last frame."""
    order: int = 5
    missing: float = 0.03
    jitter: float = 0.02
    """Rms common motion of the spots of a frame along x and y, in pitches."""
    only_last: bool = False
    """Whether only the last frame is given."""


@dataclass(frozen=True)
class Recording:
    """Frames with a known truth."""

    layout: fs.Layout
    frames: NDArray[np.float32]
    truth: NDArray[np.float64]
    """Displacements x, y [px], (n_frames, n, 2)."""
    has_spot: NDArray[np.bool_]
    case: Case = field(default_factory=Case)

    def pipeline(self) -> fs.SlopePipeline:
        """Return a pipeline for them: brightest pixels."""
        settings = fs.Settings("brightest", keep_brightest=round((self.case.fwhm_px / 0.58) ** 2))
        return fs.SlopePipeline(self.layout, settings, fs.Calibration(read_noise_e=self.case.read_noise_e))

    def is_wrong(self, slopes: fs.Slopes) -> NDArray[np.bool_]:
        """Return which slopes are those of another spot, or of none."""
        off = np.hypot(slopes.x - self.truth[..., 0], slopes.y - self.truth[..., 1])
        return (off > WRONG * self.case.pitch_px) | ~self.has_spot


def recording(seed: int, case: Case) -> Recording:
    """Simulate a recording."""
    rng = np.random.default_rng(seed)
    layout = _layout(case, hole=rng.choice([0.0, 0.3]))
    n, pitch = len(layout), case.pitch_px
    middle, radius = 0.5 * (layout.frame_shape[0] - 1), 0.5 * case.across * pitch
    orders = np.array([noll_to_nm(j)[0] for j in _MODES])
    weights = np.where(orders <= case.order, rng.normal(size=len(orders)) / orders**2, 0.0)
    gradients = mean_gradients(list(_MODES), (lenslet_outlines(layout) - middle) / radius) @ weights
    last = (case.pitches * pitch / np.hypot(*gradients).max()) * gradients.T
    ramp = np.linspace(0.0, 1.0, case.frames) if not case.only_last else np.ones(1)
    truth = ramp[:, None, None] * last + rng.normal(0.0, case.jitter * pitch, (len(ramp), 1, 2))
    has_spot = rng.random(n) >= case.missing
    light = np.stack([_light(layout, at, case) for at in (layout.centres + truth)[:, has_spot]])
    frames = rng.poisson(light) + rng.normal(0.0, case.read_noise_e, light.shape)
    return Recording(layout, frames.astype(np.float32), truth, has_spot, case)


def _layout(case: Case, hole: float) -> fs.Layout:
    """Return the lenslets of a round pupil, with room around for their spots."""
    pitch, reach = case.pitch_px, 2 * case.across
    side = case.across * pitch + 2 * int((case.pitches + 0.8) * pitch)
    cells = np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach
    if case.geometry == "hexagonal":
        at = (cells[:, 1] + cells[:, 0] * np.exp(1j * np.pi / 3)) * pitch
    else:
        at = (cells[:, 1] + 1j * cells[:, 0] + (case.across - 1) % 2 * (0.5 + 0.5j)) * pitch
    distance = np.abs(at) / (0.5 * case.across * pitch)
    lit = (distance <= 1.0) & (distance >= hole)
    cells, at = cells[lit], at[lit] + (1 + 1j) * 0.5 * (side - 1)
    window = pitch if case.geometry == "square" else int(0.86 * pitch)
    centres = np.column_stack([at.real, at.imag])
    corners = np.floor(centres[:, ::-1] - 0.5 * (window - 1) + 0.5).astype(int)
    options: dict[str, Any] = {"geometry": case.geometry, "pitch_px": float(pitch)}
    return fs.Layout((side, side), (window, window), corners, centres, cells, **options)


def _light(layout: fs.Layout, spots: NDArray[np.float64], case: Case) -> NDArray[np.float64]:
    """Return a frame of Gaussian spots at x, y (n, 2)."""
    light, sigma = np.zeros(layout.frame_shape), case.fwhm_px / 2.355
    reach = int(6 * sigma)
    around = np.arange(-reach, reach + 1)
    for x, y in spots:
        column, row = round(x), round(y)
        along, across = (np.exp(-0.5 * ((around - at) / sigma) ** 2) for at in (x - column, y - row))
        spot = case.flux_e / (2 * np.pi * sigma**2) * np.outer(across, along)
        light[row - reach : row + reach + 1, column - reach : column + reach + 1] += spot
    return light


CASES = {
    "1.5 pitches": Case(),
    "1.5 pitches, hexagonal": Case(geometry="hexagonal"),
    "1.5 pitches, 5 across": Case(across=5),
    "1.5 pitches, 20 across": Case(across=20, frames=20),
    "1.5 pitches in 10 frames": Case(frames=10),
    "1.5 pitches, 20 % without spot": Case(missing=0.2),
    "1.5 pitches, common motion 0.15 pitches": Case(jitter=0.15),
    "1.5 pitches, 300 e-": Case(flux_e=300.0),
    "1.5 pitches, 120 e-": Case(flux_e=120.0),
    "1.5 pitches, 80 e-": Case(flux_e=80.0),
    "2.5 pitches": Case(pitches=2.5),
    "last frame only, second order": Case(only_last=True, order=2),
    "last frame only, third order": Case(only_last=True, order=3),
    "last frame only, fifth order": Case(only_last=True),
}


def run() -> list[Table]:
    """Count slopes of wrong spots among valid ones, and spots that are not valid."""
    rows = []
    for name, case in CASES.items():
        wrong = valid = spots = right = whole = 0
        for seed in SEEDS:
            record = recording(seed, case)
            slopes = fs.SpotFollower(record.pipeline())(record.frames)
            is_wrong = record.is_wrong(slopes) & slopes.valid
            wrong += int(np.count_nonzero(is_wrong))
            valid += int(np.count_nonzero(slopes.valid))
            right += int(np.count_nonzero(slopes.valid & ~is_wrong))
            spots += len(record.frames) * int(np.count_nonzero(record.has_spot))
            whole += not is_wrong.any()
        values = {
            "of valid wrong (%)": 100 * wrong / max(valid, 1),
            "of spots valid and right (%)": 100 * right / spots,
            "recordings without a wrong one (%)": 100 * whole / len(SEEDS),
        }
        rows.append(Row(name, values, "wrong 1 %", bool(wrong <= MOST_WRONG * valid)))
    note = (
        f"{len(SEEDS)} recordings a row, of 40 frames unless stated; 9 lenslets across, pitch 20 px, "
        "FWHM 3 px, 3000 e- and 3 e- of read noise unless stated; brightest pixels"
    )
    return [Table("following", "Identity of spots that leave their windows", rows, [note])]
