"""Sensors for the tests of the C library, its ways in from Python, and programs that use it."""

import hashlib
import subprocess
import sys
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.estimator_cases import NEED_PSF, one_psf, random_settings

import faintspot as fs
from faintspot.adapters.library.folder import ExportedLibrary, export_library
from faintspot.adapters.library.objects import native_target
from faintspot.slopes.kernels.groups import SlopeArrays

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "library"
CACHE = Path(__file__).parent / "__pycache__" / "library"
"""Folder with kernels of earlier runs, which are found by their fingerprints."""
_WINDOW = (9, 10)


@cache
def measure_example() -> Any:
    """The example in Python, as a module."""
    spec = spec_from_file_location("library_measure", EXAMPLES / "measure.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def irregular_layout() -> fs.Layout:
    """Nineteen windows that overlap none, in no order, up to the frame's edges."""
    whole = fs.Layout.grid((5, 4), pixels=_WINDOW, pitch=(11, 12))
    return whole[np.random.default_rng(5).permutation(20)[:19]]


def pipeline_of(estimator: str, width: int | None = None, *, noise_map: bool = False) -> fs.SlopePipeline:
    """A sensor with bad pixels, reference positions and settings that differ in all sub-apertures."""
    rng, layout = np.random.default_rng(3), irregular_layout()
    n, shape = len(layout), layout.frame_shape
    settings = random_settings(rng, estimator, n, _WINDOW)
    if estimator == "tv":
        settings = settings.replace(
            noise_std=rng.uniform(0, 4, n), tolerance=rng.choice([0.0, 0.01], n), max_iterations=20
        )
    calibration = fs.Calibration(
        dark=20.0,
        gain_e_per_adu=1.7,
        bad_pixels=rng.random(shape) < 0.03,
        saturation_adu=3000.0,
        read_noise_e=rng.uniform(1.0, 4.0, shape) if noise_map else 3.0,
    )
    psf = one_psf() if estimator in NEED_PSF else None
    reference = rng.uniform(-0.5, 0.5, (n, 2))
    return fs.SlopePipeline(layout, settings, calibration, reference, psf=psf, width=width, threads=1)


def frames_of(pipeline: fs.SlopePipeline, dtype: str, count: int = 30) -> NDArray[Any]:
    """Frames of spots; the last ones of anything that a file may hold."""
    rng = np.random.default_rng(4)
    layout = pipeline.layout
    electrons, _ = fs.slopes.simulate.sensor_frames(layout, count, flux_e=300.0, rng=rng)
    frames = electrons / 1.7 + 20.0 + rng.normal(0.0, 2.0, electrons.shape)
    for frame, share in zip(frames[-8:], (0.01, 0.1, 0.5, 1.0, 0.02, 0.02, 1.0, 0.3), strict=True):
        hostile = rng.random(frame.shape) < share
        frame[hostile] = rng.choice([0.0, 65535.0, 3000.0, np.nan, np.inf, -1e30], np.count_nonzero(hostile))
    frames[-1] = 20.0
    if dtype == "float32":
        return frames.astype(np.float32)
    return np.nan_to_num(np.rint(frames), posinf=65535).clip(0, 65535).astype(np.uint16)


def exported(pipeline: fs.SlopePipeline, name: str, folder: Path = CACHE, **options: Any) -> ExportedLibrary:
    """The library for this machine's processor."""
    return export_library(pipeline, folder, name, **{"cpus": [native_target()], **options})


def sensor_of(library: ExportedLibrary, pixels: str, threads: int = 1) -> Any:
    """The sensor of a bundle, as the example in Python has it."""
    assert library.library is not None
    content = library.library.read_bytes()
    # A path that is loaded already stays what it was then.
    loaded = CACHE / f"{hashlib.sha256(content).hexdigest()[:16]}.so"
    if not loaded.exists():
        loaded.write_bytes(content)
    return measure_example().Sensor(str(loaded), library.bundle.read_bytes(), pixels, threads)


def copied(slopes: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The slopes of a frame, kept beyond the next one."""
    return {name: values.copy() for name, values in slopes.items()}


def assert_same_bits(found: dict[str, NDArray[Any]], expected: fs.Slopes | SlopeArrays) -> None:
    """All results are equal, also the sign of 0."""
    for name in SlopeArrays._fields:
        wanted = np.ascontiguousarray(getattr(expected, name))
        assert found[name].tobytes() == wanted.tobytes(), name


def run(*command: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program, which must succeed."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def python() -> str:
    return sys.executable
