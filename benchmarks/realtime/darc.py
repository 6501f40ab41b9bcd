"""faintspot as a slope module of DARC, beside DARC's own modules, in DARC's own process.

DARC is built twice: with its own flags (-O3), and with -march=native -ffast-math. Slopes are those of
simulated frames with a known truth, from DARC's circular buffers. Each module runs free, one frame at once
after the other (time of a frame, which DARC takes itself), and at 200 frames/s with a read-out of 1 ms
(latency from the last pixel to the last slope). Threads are DARC's.
"""

import importlib.util
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks import results
from benchmarks.measuring import Row, Table
from benchmarks.realtime.darc_process import MODULES, Darc, Parameters, build, missing, parameters
from faintspot.adapters.library.folder import ExportedLibrary, export_library
from faintspot.adapters.library.objects import native_target

FRAMES, FLUX_E, NOISE_E, DARK_ADU = 200, 200.0, 3.0, 100.0
FAST = "-O3 -march=native -ffast-math"
KEPT, ITERATIONS, STRENGTH_E = 9, 24, 3.0
_SETTLE_S, _FREE_S, _FEWEST, _READ, _PACED = 0.3, 1.5, 20, 200, 200
KERNELS = results.FOLDER / "library"
"""Folder of the library; later runs find the kernels there."""
_READOUT = {"CAMERA_PERIOD_US": "5000", "CAMERA_READOUT_US": "1000"}


_Recorded = dict[str, tuple[Any, Any, Any, Any]]


def configuration_example() -> Any:
    """Return examples/darc/configuration.py as a module."""
    spec = importlib.util.spec_from_file_location("darc_configuration", MODULES / "configuration.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Sensor:
    """A sensor, its frames, and the library that measures them with each estimator."""

    layout: fs.Layout
    frames: NDArray[np.uint16]
    truth_px: NDArray[np.float64]
    pipelines: dict[str, fs.SlopePipeline]
    libraries: dict[str, ExportedLibrary]
    file: Path
    """Raw frames."""

    @classmethod
    def of(
        cls,
        layout: fs.Layout,
        folder: Path,
        name: str,
        *,
        library: Path | None = None,
    ) -> "Sensor":
        """Simulate frames, and export."""
        rng = np.random.default_rng(1)
        electrons, truth = fs.slopes.simulate.sensor_frames(layout, FRAMES, flux_e=FLUX_E, rng=rng)
        noisy = electrons + rng.normal(0.0, NOISE_E, electrons.shape) + DARK_ADU
        frames = np.clip(np.rint(noisy), 0, 65535).astype(np.uint16)
        frames.tofile(folder / f"{name}.raw")
        calibration, psf = fs.Calibration(dark=DARK_ADU, read_noise_e=NOISE_E), fs.PSF.analytic()
        settings = {
            "tv": fs.Settings(
                noise_std=STRENGTH_E, keep_brightest=KEPT, max_iterations=ITERATIONS, tolerance=0.0
            ),
            "brightest": fs.Settings("brightest", keep_brightest=KEPT),
            "window": fs.Settings("window", spot_fwhm_px=2.0),
            "ml": fs.Settings("ml", flux_e=FLUX_E),
        }
        pipelines = {
            key: fs.SlopePipeline(layout, value, calibration, psf=psf if key == "ml" else None)
            for key, value in settings.items()
        }
        library = KERNELS if library is None else library
        libraries = {
            key: export_library(pipeline, library, f"{name}_{key}", cpus=[native_target()])
            for key, pipeline in pipelines.items()
        }
        return cls(layout, frames, truth, pipelines, libraries, folder / f"{name}.raw")

    def expected(self, estimator: str) -> NDArray[np.float32]:
        """Return Python's slopes of all frames in DARC's order, (FRAMES, 2 n)."""
        slopes = self.pipelines[estimator](self.frames)
        return np.stack([slopes.x, slopes.y], axis=-1).reshape(len(self.frames), -1)


def modules(sensor: Sensor, folder: Path) -> dict[str, tuple[Parameters, str]]:
    """Return the parameters that choose each module, and the estimator whose slopes they are."""
    i, f, n = np.int32, np.float32, len(sensor.layout)
    width = next(iter(sensor.pipelines.values())).width
    found: dict[str, tuple[Parameters, str]] = {
        "DARC, centre of gravity": ({}, ""),
        f"DARC, {KEPT} brightest": ({"useBrightest": i(-KEPT)}, ""),
        f"DARC, TV, {ITERATIONS} iterations": (
            {
                "useBrightest": i(-KEPT),
                "totVarMin": np.full(n, STRENGTH_E, f),
                "tvmMaxIter": np.full(n, ITERATIONS, i),
            },
            "",
        ),
    }
    names = {"tv": f"TV, {ITERATIONS} iterations", "brightest": f"{KEPT} brightest"}
    for estimator, library in sensor.libraries.items():
        chosen = configuration_example().slope_module(
            sensor.layout, folder / "libfaintspotslope.so", library.bundle, width
        )
        found[f"faintspot, {names.get(estimator, estimator)}"] = chosen, estimator
    return found


def aligned(numbers: NDArray[np.int32], slopes: NDArray[np.float32], sensor: Sensor) -> NDArray[np.int32]:
    """Return which frame of the file each frame of DARC was: its numbers begin anywhere."""
    truth = sensor.truth_px.reshape(len(sensor.frames), -1)
    some = slice(0, 20)
    offsets = range(len(truth))
    errors = [np.abs(slopes[some] - truth[(numbers[some] + o) % len(truth)]).mean() for o in offsets]
    return (numbers + int(np.argmin(errors))) % len(truth)


def _recorded(sensor: Sensor, folder: Path, base: Parameters, chosen: Mapping[str, Parameters]) -> _Recorded:
    """Run all modules, free and then paced; return times of frames, numbers, slopes and latencies of each.

    DARC's threads have real-time priority: nothing is computed meanwhile.
    """
    ring_file, found = folder / "ring", dict[str, Any]()
    files = {"CAMERA_FRAMES": str(sensor.file), "RING": str(ring_file)}
    for pace in ({}, _READOUT):
        np.zeros(4097).tofile(ring_file)
        ring = np.memmap(ring_file, np.float64, "r", shape=(4097,))
        with Darc(folder, "faintspot_b_", base, {**files, **pace}) as darc:
            for name, values in chosen.items():
                darc.switch(base | values)
                time.sleep(_SETTLE_S)
                begin = darc.slopes.number
                if pace:
                    darc.next(_PACED)
                    found[name] = *found[name], ring[1 + (int(ring[0]) - np.arange(_PACED)) % 4096]
                    continue
                time.sleep(_FREE_S)
                darc.next(_FEWEST)
                # Few enough to be copied before DARC writes over them.
                newest = max(begin, darc.slopes.number - _READ)
                found[name] = darc.times.since(begin)[1][:, 0], *darc.slopes.since(newest)
    return found


def _rows(sensor: Sensor, folder: Path, threads: int, flags: str) -> list[Row]:
    """Measure the modules of a build; with fast flags, DARC's own alone."""
    every = modules(sensor, folder)
    chosen = {name: each for name, each in every.items() if "DARC" in name or not flags}
    base = parameters(sensor.layout, folder, DARK_ADU, threads)
    recorded = _recorded(sensor, folder, base, {name: values for name, (values, _) in chosen.items()})
    truth, rows = sensor.truth_px.reshape(len(sensor.frames), -1), []
    for name, (taken_s, numbers, slopes, latency_us) in recorded.items():
        which, estimator = aligned(numbers, slopes, sensor), chosen[name][1]
        same = np.mean(slopes == sensor.expected(estimator)[which]) if estimator else np.nan
        values = {
            "frame, us": 1e6 * np.median(taken_s),
            "10 %, us": 1e6 * np.quantile(taken_s, 0.1),
            "latency, us": np.median(latency_us),
            "99 %, us": np.quantile(latency_us, 0.99),
            "error, px": (slopes - truth[which]).std(),
            "as Python": same,
        }
        known = {key: float(value) for key, value in values.items() if not np.isnan(value)}
        rows.append(Row(f"{name}{flags}", known))
    return rows


def early_stop(sensor: Sensor, folder: Path) -> Table:
    """Compare DARC's TV with its early stop (`tvmPrecision`) and without, at most 200 iterations."""
    f, n, truth = np.float32, len(sensor.layout), sensor.truth_px.reshape(len(sensor.frames), -1)
    base = parameters(sensor.layout, folder, DARK_ADU) | {"useBrightest": np.int32(-KEPT)}
    base |= {"totVarMin": np.full(n, STRENGTH_E, f), "tvmMaxIter": np.full(n, 200, np.int32)}
    slow = {"CAMERA_FRAMES": str(sensor.file), "RING": str(folder / "ring"), "CAMERA_PERIOD_US": "40000"}
    recorded = {}
    with Darc(folder, "faintspot_b_", base, slow) as darc:
        for precision in (0.0, 0.001, 0.01, 0.1):
            darc.switch(base | {"tvmPrecision": np.full(n, precision, f)})
            darc.next(2)
            recorded[precision] = darc.next(len(truth))
    rows, slopes_of = [], {}
    for precision, (numbers, slopes) in recorded.items():
        which = aligned(numbers, slopes, sensor)
        slopes_of[precision] = slopes[np.argsort(which)]
        difference = slopes_of[precision] - slopes_of[0.0]
        values = {
            "error, px": float((slopes - truth[which]).std()),
            "rms difference, px": float(difference.std()),
        }
        rows.append(Row(f"tvmPrecision {precision:g}", values))
    return Table("early_stop", "Early stop of DARC's TV, 36 sub-apertures", rows)


def run() -> list[Table]:
    """Measure both sensors with one and two threads, and DARC's own modules also with its fastest flags."""
    if lacking := missing():
        return [Table("modules", "Slope modules in DARC", [], [f"not measured: missing {lacking}"])]
    tables = []
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        small = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)
        large = fs.Layout.grid((40, 40), pixels=8, outer_radius=20.0, inner_radius=4.0)
        sensors = [Sensor.of(small, root, "small"), Sensor.of(large, root, "large")]
        library = next(iter(sensors[0].libraries.values()))
        builds = {"": build(root / "usual", library), " (fast flags)": build(root / "fast", library, FAST)}
        for sensor in sensors:
            for threads in (1, 2):
                rows = [row for flags in builds for row in _rows(sensor, builds[flags], threads, flags)]
                n, (ny, nx) = len(sensor.layout), sensor.layout.window
                title = f"{n} sub-apertures of {ny} x {nx} pixels, {threads} thread{'s' * (threads > 1)}"
                tables.append(Table(f"modules_{n}_{threads}", title, rows))
        tables.append(early_stop(sensors[0], builds[""]))
    return tables
