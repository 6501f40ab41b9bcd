"""faintspot against what one would otherwise use, on one processor.

All do the same work: 16 x 16 pixels in float32, 20 iterations, the 12 brightest pixels, centre of gravity;
each is first shown to give the same positions. faintspot reads them out of a camera frame; the others are
handed the stack of images, ready made.

- scikit-image: `denoise_tv_chambolle`, image after image, with the weight that faintspot's solution has (it
  does not solve the constrained problem, so that something else would have to find the weight). It makes 20
  iterations of Chambolle's algorithm (`eps=0`, the last update is not used), which come less close to the
  solution than 20 of faintspot's; its positions are therefore compared where both have converged.
- NumPy and JAX: faintspot's algorithm, see rival_numpy.py and rival_jax.py. All
  images at once, and in blocks that fit the cache; the faster one counts.

Optional packages that are not installed are named below the table.
"""

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.frames.rival_numpy import NumpyRival, locate
from benchmarks.measuring import Candidate, Row, Table, Times, best, interleaved, pinned, ratio
from faintspot.slopes.estimators import estimator_named

ITERATIONS, KEEP, NOISE_STD, FLUX_E = 20, 12, 0.45, 200.0
NUMPY_BLOCKS = (64, 128, 256, 512)
JAX_BLOCKS = (64, 128, 256)
MODULES = {
    "skimage": "scikit-image",
    "jax": "jax",
}
"""Optional rivals: what to import, and what to install."""
SKIMAGE_IMAGES = 36  # takes one image after the other: so many tell the time of one
TARGETS = {"scikit-image": 200.0, "NumPy": 9.0, "JAX": 9.0}
SAME_POSITION_PX = 2e-3  # same algorithm from p = 0: after so many iterations the start is all but forgotten
SAME_SOLUTION_PX = 0.01  # another algorithm, where both have converged

GRIDS = {
    36: (7, 3.5, 0.5),
    100: (10, 9.0, 0.0),
    316: (20, 10.0, 0.0),
    1208: (40, 19.9, 3.4),
    4616: (80, 40.0, 11.5),
}
"""Side, outer radius and radius of the obstruction of a pupil with so many sub-apertures."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Problem:
    """A frame, the same as a stack of images (n, ny, nx), and the pipeline that measures it."""

    layout: fs.Layout
    frame: Floats
    images: Floats
    pipeline: fs.SlopePipeline

    def slopes(self) -> Floats:
        """Return faintspot's positions (n, 2)."""
        slopes = self.pipeline(self.frame)
        return np.stack([slopes.x, slopes.y], axis=1)


def layout_of(n: int, pixels: int = 16) -> fs.Layout:
    """Return the layout with n sub-apertures: that of GRIDS, or a row of them."""
    if n not in GRIDS:
        return fs.Layout.grid((1, n), pixels=pixels)
    side, outer, inner = GRIDS[n]
    return fs.Layout.grid((side, side), pixels=pixels, outer_radius=outer, inner_radius=inner)


def problem(
    n: int,
    pixels: int = 16,
    *,
    threads: int = 1,
    width: int | None = None,
    estimator: str = "tv",
    **settings: Any,
) -> Problem:
    """Simulate faint spots and put them into a frame."""
    layout = layout_of(n, pixels)
    generator = np.random.default_rng(n)
    images, _ = fs.slopes.simulate.subapertures(n, shape=(pixels, pixels), flux_e=FLUX_E, rng=generator)
    frame = np.zeros(layout.frame_shape, np.float32)
    for (row, column), image in zip(layout.corners, images, strict=True):
        frame[row : row + pixels, column : column + pixels] = image
    kind = estimator_named(estimator)
    usual = {
        "noise_std": NOISE_STD,
        "tolerance": 0.0,
        "max_iterations": ITERATIONS,
        "keep_brightest": KEEP,
    } | settings
    chosen = kind(**{name: value for name, value in usual.items() if name in kind.declared()})
    pipeline = fs.SlopePipeline(layout, chosen, threads=threads, width=width)
    return Problem(layout, frame, np.ascontiguousarray(images), pipeline)


def available(package: str) -> bool:
    """Whether an optional package is installed."""
    return importlib.util.find_spec(package) is not None


# Rivals ------------------------------------------------------------------------------------------------


def numpy_rival(case: Problem, block: int) -> Callable[[], Floats]:
    """Return the NumPy version, in blocks of at most `block` images."""
    ny, nx = case.layout.window
    rival = NumpyRival(ny, nx, min(block, len(case.images)), NOISE_STD, KEEP, ITERATIONS)
    return lambda: rival(case.images)


def jax_rival(case: Problem, block: int) -> Callable[[], Any]:
    """Return the JAX version, in blocks of `block` images."""
    from benchmarks.frames.rival_jax import jax_rival as make

    return make(case.images, block, NOISE_STD, KEEP, ITERATIONS)


def skimage_rival(images: NDArray[Any], weights: NDArray[Any], iterations: int) -> Callable[[], NDArray[Any]]:
    """Return scikit-image's denoising in a loop, then the same NumPy code as in the NumPy version."""
    from skimage.restoration import denoise_tv_chambolle

    def run() -> NDArray[Any]:
        denoised = np.empty_like(images)
        for i in range(len(images)):
            denoised[i] = denoise_tv_chambolle(images[i], weight=weights[i], eps=0.0, max_num_iter=iterations)
        return locate(denoised, KEEP)

    return run


def difference(case: Problem, rival: Callable[[], Any]) -> float:
    """Return the largest difference between a rival's positions and faintspot's, px."""
    return float(np.abs(np.asarray(rival()) - case.slopes()).max())


def skimage_difference(case: Problem, count: int = 4, iterations: int = 2000) -> float:
    """Return the largest difference of `count` positions where both have converged, px."""
    images = case.images[:count].astype(np.float64)
    ours = fs.tv_denoise(images, NOISE_STD, tolerance=1e-7, max_iterations=iterations, full_output=True)
    theirs = skimage_rival(images, ours.multiplier, iterations)()
    return float(np.abs(theirs - locate(ours.images, KEEP)).max())


SAME_ALGORITHM: dict[str, tuple[str, Callable[[Problem, int], Candidate], tuple[int, ...]]] = {
    "NumPy": ("numpy", numpy_rival, NUMPY_BLOCKS),
    "JAX": ("jax", jax_rival, JAX_BLOCKS),
}
"""What to import, how to make it run, and its block sizes."""

# Measurements ------------------------------------------------------------------------------------------


def _row(name: str, n: int, times: Times, rival: str, differs_px: float, target: float | None = None) -> Row:
    found = ratio(times, rival, "faintspot")
    values = {
        "faintspot us": best(times, "faintspot") / n * 1e6,
        "rival us": best(times, rival) / n * 1e6,
        **found.values,
        "differs px": differs_px,
    }
    if target is None:
        return Row(name, values, spread=found.spread, better="higher")
    return Row(name, values, f">= {target:g}", found.smaller >= target, found.spread)


def _check(name: str, differs: float, limit: float) -> float:
    if not differs <= limit:
        raise AssertionError(f"{name}: differs from faintspot by {differs:g}, expected at most {limit:g}")
    return differs


def _fastest(case: Problem, name: str, make: Callable[[Problem, int], Candidate], blocks: Any) -> Any:
    """Return the fastest of a rival's block sizes, in words and ready to run; all are shown to be right."""
    n = len(case.images)
    sizes = [*(b for b in blocks if b < n), n]
    rivals = {block: make(case, block) for block in sizes}
    for rival in rivals.values():
        _check(name, difference(case, rival), SAME_POSITION_PX)
    times = interleaved({str(block): rival for block, rival in rivals.items()}, seconds=0.0, fewest=5)
    block = min(rivals, key=lambda b: best(times, str(b)))
    return f"{n}: {name}, {f'blocks of {block}' if block < n else 'all at once'}", rivals[block]


def _same_algorithm(n: int) -> tuple[list[Row], list[str]]:
    """Compare with NumPy and JAX; also return in words which block sizes were the fastest."""
    case, rivals, fastest = problem(n), {}, []
    for name, (module, make, blocks) in SAME_ALGORITHM.items():
        if available(module):
            words, rivals[name] = _fastest(case, name, make, blocks)
            fastest.append(words)
    times = interleaved({"faintspot": case.slopes} | rivals, seconds=5.0 if n < 100 else 15.0)
    rows = [
        _row(f"{n}: {name}", n, times, name, difference(case, run), TARGETS.get(name))
        for name, run in rivals.items()
    ]
    return rows, fastest


def _against_skimage(n: int) -> Row:
    """Compare with scikit-image; of many images it gets the first SKIMAGE_IMAGES, for short turns."""
    case = problem(n)
    differs = _check("scikit-image", skimage_difference(case), SAME_SOLUTION_PX)
    images = case.images[:SKIMAGE_IMAGES]
    solved = fs.tv_denoise(images, NOISE_STD, tolerance=0.0, max_iterations=ITERATIONS, full_output=True)
    rival = skimage_rival(images, solved.multiplier, ITERATIONS)
    times = interleaved({"faintspot": case.slopes, "rival": rival}, seconds=5.0)
    times["rival"] *= n / len(images)
    return _row(f"{n}: scikit-image", n, times, "rival", differs, TARGETS["scikit-image"])


def _missing(*modules: str) -> list[str]:
    return [f"not installed: pip install {MODULES[name]}" for name in modules if not available(name)]


def _threads_used(run: Candidate) -> float:
    """Return processor time per wall time: above 1 where more than one thread works."""
    run()
    processor, wall = time.process_time(), time.perf_counter()
    for _ in range(200):
        run()
    return (time.process_time() - processor) / (time.perf_counter() - wall)


def run() -> list[Table]:
    """Run the comparisons."""
    notes = ["us per sub-aperture, best of all turns; a target is met when both ratios meet it"]
    with pinned():
        rows = []
        for n in (36, 4616):
            found, fastest = _same_algorithm(n)
            rows += found
            notes.append("; ".join(fastest))
            if available("skimage"):
                rows.append(_against_skimage(n))
        if available("jax"):
            used = _threads_used(jax_rival(problem(36), 36))
            notes.append(f"JAX used {used:.2f} threads")
        notes += _missing("skimage", "jax")
        title = "Frame to slopes, one thread: faintspot against others"
        return [Table("rivals", title, rows, notes)]
