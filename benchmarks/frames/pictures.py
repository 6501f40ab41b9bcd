"""Does the time of an estimator depend on what is in the frame: faint, bright, empty, dark, saturated?

Frame to slopes, 16 x 16 pixels, 1024 sub-apertures, one thread, all frames in turns. Real time has to keep up
with the slowest frame, so what counts is the ratio of the slowest to the fastest. Estimators of fixed work
must stay within 1.3. Denoising has nothing to do on constant images (dark, saturated): they are left out;
"tv, accurate" iterates until its images have converged, and takes what it takes.
"""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.frames.estimators import KEEP, NOISE_STD, pipelines
from benchmarks.measuring import Candidate, Row, Table, best, interleaved, pinned

SHAPE, SIDE, READ_NOISE_E = (32, 32), 16, 3.0
LIMIT = 1.3
ITERATES = "tv, accurate"
CONSTANT = ("dark", "saturated")
SECONDS = 3.0


def frames(layout: fs.Layout) -> dict[str, NDArray[np.uint16]]:
    """Return one frame a kind of light, ADU (electrons on a pedestal of 100)."""
    rng = np.random.default_rng(3)
    camera = fs.slopes.simulate.Detector(read_noise_e=READ_NOISE_E)

    def spots(flux_e: float) -> NDArray[np.uint16]:
        frame, _ = fs.slopes.simulate.sensor_frames(layout, 1, flux_e=flux_e, detector=camera, rng=rng)
        pixels: NDArray[np.uint16] = np.clip(np.rint(frame[0] + 100.0), 0, 65535).astype(np.uint16)
        return pixels

    return {
        "faint": spots(40.0),
        "bright": spots(20000.0),
        "empty": spots(0.0),
        "dark": np.full(layout.frame_shape, 100, np.uint16),
        "saturated": np.full(layout.frame_shape, 65535, np.uint16),
    }


def _table() -> Table:
    layout = fs.Layout.grid(SHAPE, pixels=SIDE)
    seen = frames(layout)
    cases: dict[str, Any] = pipelines(layout, fs.Calibration(100.0, read_noise_e=READ_NOISE_E))
    cases[ITERATES] = cases["tv"].with_settings(fs.Settings("tv", noise_std=NOISE_STD, keep_brightest=KEEP))
    rows = []
    for name, pipeline in cases.items():
        candidates: dict[str, Candidate] = {kind: partial(pipeline, frame) for kind, frame in seen.items()}
        times = interleaved(candidates, seconds=SECONDS)
        each = {kind: best(times, kind) / len(layout) * 1e6 for kind in seen}
        counted = [time for kind, time in each.items() if kind not in CONSTANT or not name.startswith("tv")]
        ratio = max(counted) / min(counted)
        values = {f"{kind}: us per sub-aperture": time for kind, time in each.items()}
        values["slowest / fastest"] = ratio
        if name == ITERATES:
            rows.append(Row(name, values, better="lower"))
        else:
            rows.append(Row(name, values, f"<= {LIMIT}", ratio <= LIMIT))
    return Table("pictures", f"Time by what is in the frame, {len(layout)} sub-apertures", rows, [])


def run() -> list[Table]:
    """Time all estimators on all frames."""
    with pinned():
        return [_table()]
