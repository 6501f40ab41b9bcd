"""Every kernel on hostile frames, with all that it reads and writes between guard pages.

Slopes must be those of the same frames in ordinary memory, bit by bit, and finite; slopes of ordinary spots
must be those of the oracle.
"""

import contextlib
import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from tests import estimator_cases
from tests.estimator_cases import (
    NEED_PSF,
    assert_same,
    assert_sane,
    one_of_several,
    one_psf,
    random_case,
    with_options,
)
from tests.estimator_oracle import assert_equals_oracle
from tests.fuzz.guarded import guarded, guarded_tree
from tests.refusals import refused_in_one_line

import faintspot as fs
from faintspot.base.tables import PRESETS
from faintspot.engine.frames.frame_path import FramePath, Progress
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.centroid import brightest_pixels
from faintspot.slopes.kernels import parallel
from faintspot.slopes.kernels.groups import STAGE_ROWS, SlopeArrays, new_scratch
from faintspot.slopes.kernels.host import WIDTHS
from faintspot.slopes.pipeline import slope_pipeline
from faintspot.slopes.pipeline.plan import kernel_frames
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes, prior_slopes
from faintspot.slopes.spots.psf import PSF

DTYPES = ("uint16", "float32")
_HOSTILE = (np.nan, np.inf, -np.inf, 1e38, -1e38, 0.0, 65535.0, 1e-38)
_LONG = ("max_iterations", "tolerance")  # which make it slow, not hostile


def combinations(widths: tuple[int, ...] = WIDTHS) -> list[tuple[str, int, str]]:
    """Estimators, SIMD widths and types of pixels."""
    return list(itertools.product(estimators(), widths, DTYPES))


def run(seed: int, chosen: list[tuple[str, int, str]]) -> None:
    """Measure one random sensor, with one of these combinations in turn."""
    estimator, width, dtype = chosen[seed % len(chosen)]
    case = random_case(seed, estimator, n=2)
    assert_equals_oracle(case, case.measure(width=width))
    rng = np.random.default_rng(seed)
    at_end = bool(rng.random() < 0.5)
    pipeline = refused_in_one_line(lambda: _pipeline(rng, estimator, width))
    if pipeline is None:
        return
    prior = _prior(rng, len(pipeline.layout))
    frames = _frames(rng, pipeline.layout.frame_shape, dtype)
    expected = refused_in_one_line(lambda: pipeline(frames, prior))
    if expected is None:
        return
    assert_sane(expected)
    assert_same(_measured(pipeline, frames, prior, at_end, rng), expected)
    if not pipeline.needs_flux and prior is None:
        found, wanted = _streamed(pipeline, frames, at_end), pipeline(frames)
        for name in SlopeArrays._fields:
            assert np.array_equal(getattr(found, name), getattr(wanted, name)[0]), name
    _stacks(rng, at_end)


# Sensors ----------------------------------------------------------------------------------------------


def _pipeline(rng: np.random.Generator, estimator: str, width: int) -> fs.SlopePipeline:
    layout = _layout(rng)
    n = len(layout)
    settings = estimator_cases.random_settings(rng, estimator, n, layout.window)
    settings = with_options(settings, **_extremes(rng, settings))
    psf = None
    if estimator in NEED_PSF:
        kinds = one_of_several(rng.integers(0, 3, n))
        psf = [one_psf(), kinds, PSF.analytic("gaussian", size=0.3, radius_px=3)][rng.integers(3)]
    reference = rng.uniform(-1, 1, (n, 2)) * rng.choice([1.0, 30.0])
    calibration = _calibration(rng, layout.frame_shape)
    return fs.SlopePipeline(layout, settings, calibration, reference, psf=psf, width=width, threads=1)


def _layout(rng: np.random.Generator) -> fs.Layout:
    """Windows side by side up to the frame's very edges, some left out."""
    window = (int(rng.integers(4, 21)), int(rng.integers(4, 21)))
    rows, columns = (int(n) for n in rng.integers(1, 6, 2))
    pitch = (window[0] + int(rng.integers(0, 3)), window[1] + int(rng.integers(0, 3)))
    whole = fs.Layout.grid((rows, columns), pixels=window, pitch=pitch)
    kept = rng.random(len(whole)) < 0.8
    kept[[0, -1]] = True
    return whole[rng.permutation(np.flatnonzero(kept)) if rng.random() < 0.5 else kept]


def _calibration(rng: np.random.Generator, shape: tuple[int, int]) -> fs.Calibration:
    dark = rng.normal(20.0, 1.0, shape)
    dark[rng.random(shape) < 0.05] = rng.choice(_HOSTILE)
    noise = rng.choice([0.0, 0.3, 3.0, 1e6, np.nan], shape)
    return fs.Calibration(
        dark=dark if rng.random() < 0.5 else 20.0,
        gain_e_per_adu=float(rng.choice([1e-9, 1.0, 1.7, 1e9])),
        em_gain=float(rng.choice([1.0, 50.0])),
        bad_pixels=rng.random(shape) < rng.choice([0.0, 0.05, 0.9]),
        saturation_adu=float(rng.choice([1.0, 3000.0, 1e30])),
        read_noise_e=noise if rng.random() < 0.3 else float(rng.choice([0.0, 0.3, 3.0, 1e6])),
        background_e=float(rng.choice([0.0, 2.0, 1e9])),
    )


def _extremes(rng: np.random.Generator, settings: fs.Settings) -> dict[str, Any]:
    """Some options at the ends of what they may be."""
    found: dict[str, Any] = {}
    for name, option in settings.declared().items():
        if name in _LONG or rng.random() < 0.85:
            continue
        if option.choices:
            found[name] = str(rng.choice(option.choices))
            continue
        end = option.low if rng.random() < 0.5 else option.high
        if np.isfinite(end):
            found[name] = end + (1e-6 if option.low_open and end == option.low else 0.0)
    return found


def _frames(rng: np.random.Generator, shape: tuple[int, int], dtype: str) -> NDArray[Any]:
    frames = rng.poisson(rng.choice([0.1, 5.0, 500.0]), (int(rng.integers(1, 4)), *shape)) + 20.0
    hostile = rng.random(frames.shape) < rng.choice([0.0, 0.02, 0.5, 1.0])
    frames[hostile] = rng.choice(_HOSTILE, np.count_nonzero(hostile))
    with np.errstate(over="ignore", invalid="ignore"):
        return (
            np.nan_to_num(frames).clip(0, 65535).astype(dtype) if dtype == "uint16" else frames.astype(dtype)
        )


def _prior(rng: np.random.Generator, n: int) -> NDArray[np.float32] | None:
    kind = rng.integers(3)
    if kind == 0:
        return None
    return rng.normal(0, [1.0, 100.0][kind - 1], 2 * n).astype(np.float32)


# Kernels ----------------------------------------------------------------------------------------------


def _measured(
    pipeline: fs.SlopePipeline,
    frames: NDArray[Any],
    prior: NDArray[np.float32] | None,
    at_end: bool,
    rng: np.random.Generator,
) -> Slopes:
    """Call the kernel as the pipeline does, with everything guarded."""
    n, n_frames = len(pipeline.layout), len(frames)
    guard = partial(guarded_tree, at_end=at_end)
    plan, lanes, window = pipeline.plan, pipeline._lanes, pipeline.layout.window
    source = guard(pipeline.source(kernel_frames(frames), frames.dtype))
    groups = n_frames * -(-n // lanes.width)
    own = plan.own_scratch
    scratch = guard(new_scratch(lanes, *window, own(lanes, *window)))
    if plan.prepared.needs_flux:
        flux = guard(np.empty((n_frames, n), np.float32))
        plan.flux_kernel(source, 0, groups, scratch, flux)
        variants = plan.variants(flux.mean(axis=1, dtype=np.float64))
    else:
        variants = np.zeros(n_frames, np.int64)
    predicted = None if prior is None else prior_slopes(prior, n_frames, pipeline.layout)
    task = guard(plan.task(variants, predicted))
    results = guard(SlopeArrays(*(np.empty((n_frames, n), kind) for kind in RESULT_TYPES)))
    rows = STAGE_ROWS * int(rng.integers(2))
    stages = guard(np.empty((rows, n_frames, n, pipeline.layout.pixels), np.float32))
    plan.kernel(source, task, 0, groups, scratch, results, stages)
    pipeline.flag_doubtful(results, guard(kernel_frames(frames)))
    return Slopes(*results)


def _streamed(pipeline: fs.SlopePipeline, frames: NDArray[Any], at_end: bool) -> Slopes:
    """Measure the first frame as the engine does, all of whose rows are there."""
    cells = guarded(np.array([1, 0], np.int64), at_end)
    with _guarded_scratch(at_end):
        path = FramePath(pipeline, [guarded(frames[0], at_end)], Progress(cells, 0, 1))
    for groups in filter(None, (path._wide, path._narrow)):
        groups.arguments = [
            work._replace(source=guarded_tree(work.source, at_end), task=guarded_tree(work.task, at_end))
            for work in groups.arguments
        ]
        groups._last_rows = guarded(groups._last_rows, at_end)
    assert path.measure(0)
    path.flag_doubtful()
    return path.slopes


def _stacks(rng: np.random.Generator, at_end: bool) -> None:
    """The steps of the centre of gravity on stacks of images."""
    dtype = rng.choice(["float32", "float64"])
    shape = tuple(int(n) for n in rng.integers((1, 4, 4), (20, 21, 21)))
    images = rng.normal(0, 1, shape) * 10.0 ** rng.integers(-30, 30, (shape[0], 1, 1))
    images = np.where(rng.random(shape) < 0.02, rng.choice([0.0, 1e29, -1e29], shape), images).astype(dtype)
    kept = int(rng.integers(1, shape[1] * shape[2]))
    strength = 10.0 ** rng.integers(-30, 30)
    calls: list[Any] = [
        partial(fs.tv_denoise, noise_std=strength, max_iterations=20, preset=str(rng.choice(PRESETS))),
        partial(brightest_pixels, keep=kept),
        fs.centre_of_gravity,
    ]
    for call in calls:
        with _guarded_scratch(at_end), np.errstate(all="ignore"):
            found = call(guarded(images, at_end))
        with np.errstate(all="ignore"):
            assert np.array_equal(found, call(images)), call
        assert np.all(np.isfinite(found)), call


@contextlib.contextmanager
def _guarded_scratch(at_end: bool) -> Iterator[None]:
    """Make the scratch of kernels guarded."""

    def make(*arguments: Any) -> Any:
        return guarded_tree(new_scratch(*arguments), at_end)

    known = vars(parallel._local)  # what this thread has made already
    with (
        mock.patch.object(parallel, "new_scratch", make),
        mock.patch.object(slope_pipeline, "new_scratch", make),
    ):
        known.pop("known", None)
        yield
        known.pop("known", None)
