"""What each estimator costs, against the pipeline with TV denoising (20 iterations, brightest pixels).

Frame to slopes, 16 x 16 pixels, one thread, all in turns. "of TV pipeline" is the ratio of the whole times.
"own, of 20 iterations" is what an estimator adds to gathering and calibrating the images (timed as the sum of
every window's pixels), over what 20 iterations add to the pipeline without denoising. Positions are sought
within +-1 px, and in the rows marked "whole window" everywhere.
"""

from functools import partial
from typing import Any

import numpy as np

import faintspot as fs
from benchmarks.measuring import Candidate, Row, Table, Times, best, interleaved, pinned, ratio
from faintspot.slopes.estimators import estimator_named
from faintspot.slopes.kernels.groups import Source, flux_of_groups, new_scratch
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.pipeline.plan import packed_calibration

ITERATIONS, KEEP, NOISE_STD, FLUX_E, READ_NOISE_E = 20, 12, 0.45, 200.0, 0.1
SHAPES = ((6, 6), (32, 32))
LIMITS = {"ml": 0.35, "weighted": 0.35}


def pipelines(layout: fs.Layout, calibration: fs.Calibration) -> dict[str, fs.SlopePipeline]:
    """Return every estimator's pipeline."""
    psf = fs.PSF.analytic()
    rotated = fs.PSF.analytic(elongation=2.0, angle_deg=30.0)

    def pipeline(estimator: str, spot: fs.PSF = psf, **settings: Any) -> fs.SlopePipeline:
        if "keep_brightest" in estimator_named(estimator).declared():
            settings["keep_brightest"] = KEEP
        chosen = fs.Settings(estimator, **settings)
        return fs.SlopePipeline(layout, chosen, calibration, psf=spot, threads=1)

    near: dict[str, Any] = {"search_range_px": 1.0}
    tv: dict[str, Any] = {"noise_std": NOISE_STD, "tolerance": 0.0, "max_iterations": ITERATIONS}
    return {
        "tv": pipeline("tv", **tv),
        "brightest": pipeline("brightest"),
        "centroid": pipeline("centroid"),
        "thresholded": pipeline("thresholded", threshold_e=0.5),
        "smoothed": pipeline("smoothed", smoothing_px=0.7),
        "weighted": pipeline("weighted", **near),
        "ml": pipeline("ml", **near),
        "ml, whole window": pipeline("ml"),
        "ml, rotated elongated PSF": pipeline("ml", rotated, **near),
        "map": pipeline("map", flux_e=FLUX_E, **near),
        "map, prior of 0.3 px": pipeline("map", flux_e=FLUX_E, prior_std_px=0.3, **near),
    }


def _gather(layout: fs.Layout, frame: Any) -> Candidate:
    """Return a run of gathering and calibrating alone."""
    lanes = lanes_for(np.float32)
    n, (ny, nx) = len(layout), layout.window
    calibration = packed_calibration(layout, fs.Calibration().maps(layout.frame_shape), lanes.width)
    scratch, flux = new_scratch(lanes, ny, nx), np.empty((1, n), np.float32)
    groups = -(-n // lanes.width)
    source = Source(lanes, frame[None], layout.corners, ny, nx, calibration, np.inf)

    def run() -> None:
        flux_of_groups(source, 0, groups, scratch, flux)

    return run


def own_cost(times: Times, name: str) -> float:
    """Return what an estimator adds to gathering, over what 20 iterations add to the pipeline without."""
    added = best(times, name) - best(times, "gather")
    return added / (best(times, "tv") - best(times, "brightest"))


def _row(name: str, n: int, times: Times) -> Row:
    whole, own = ratio(times, name, "tv", ("of TV pipeline", "median")), own_cost(times, name)
    values = {
        "us per sub-aperture": best(times, name) / n * 1e6,
        **whole.values,
        "own, of 20 iterations": own,
    }
    if name in LIMITS:
        target, met = f"<= {LIMITS[name]} of TV pipeline", whole.larger <= LIMITS[name]
        return Row(name, values, target, met, whole.spread)
    return Row(name, values, spread={} if name == "tv" else whole.spread, better="lower")


def _table(shape: tuple[int, int]) -> Table:
    layout = fs.Layout.grid(shape, pixels=16)
    frames, _ = fs.slopes.simulate.sensor_frames(
        layout,
        1,
        flux_e=FLUX_E,
        rng=np.random.default_rng(2),
    )
    frame, n = frames[0], len(layout)
    cases = pipelines(layout, fs.Calibration(dark=0.0, read_noise_e=READ_NOISE_E))
    candidates: dict[str, Candidate] = {name: partial(pipeline, frame) for name, pipeline in cases.items()}
    times = interleaved(candidates | {"gather": _gather(layout, frame)}, seconds=12.0)
    rows = [_row(name, n, times) for name in cases]
    notes = [f"gathering and calibrating: {best(times, 'gather') / n * 1e6:.3f} us"]
    return Table(f"estimators_{n}", f"Estimators, {n} sub-apertures of 16 x 16 pixels", rows, notes)


def run() -> list[Table]:
    """Time all estimators on a small and a large sensor."""
    with pinned():
        return [_table(shape) for shape in SHAPES]
