"""Do variants of the paper's TV denoising do better than its constraint with the automatic strength?

Prints four Markdown tables. Two are of single frames, R (slope error) and the gain-corrected rms of penalised
TV (one multiplier for all images), TV of the whole frame, TV with a border of zeros, and rivals, divided by
those of `faintspot.tv_denoise` with the automatic strength and number of kept pixels. Two are of spots that
move, with successive frames added up before TV, divided by those of brightest pixels with an exponential
smoothing of the slopes. Settings are chosen on one sample, by the quantity of the table, and scored on
another. Standard errors: jackknife over frames, or over sequences of frames.

    python -m benchmarks.paper.tv_variants --realisations 1960
"""

import argparse
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import faintspot as fs
from faintspot.base.statistics import slope_statistics
from faintspot.experiments.study.cell_methods import position_table
from faintspot.experiments.study.sweep import Cell
from faintspot.slopes.estimators.automatic import automatic_kept_pixels, automatic_strength
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.simulate import Detector, subapertures

SIDE = 16
LENSLETS = 7  # sub-apertures along a side of the frame
KEPT = np.array([4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 18, 20, 23, 26, 30, 35, 40, 50, 60, 80, 110, 150, 200])
STRENGTHS = (0.3, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95, 1.0, 1.05)  # of the noise of a mean pixel
MOVING_STRENGTHS = (0.3, 0.6, 0.8, 0.9, 1.0)
MULTIPLIERS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0, 1.2, 1.5, 2.0)  # of the noise of a mean pixel
WIDTHS_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.3)
GAINS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0)
UNEVEN = 0.7  # fluxes of uneven frames are within 1 +- this of the mean
CORRELATIONS = (0.9, 0.98, 0.995)
MOTION_PX = 0.5  # standard deviation of moving spots
SETTLING, SCORED = 24, 20  # frames of a sequence: 0.9 ** 24 of the start is left in the slowest filter
QUANTITIES = ("R", "gain-corrected rms")

Images = NDArray[np.float32]
Floats = NDArray[np.float64]


def cases() -> list[Cell]:
    """Return what is measured."""
    fluxes = {0.1: (10, 30, 100, 300), 1.0: (30, 100), 3.0: (60, 80, 200, 500), 16.0: (300, 1000)}
    chosen = [("diffraction", noise, flux, 1.0) for noise, values in fluxes.items() for flux in values]
    chosen += [("gaussian", 0.1, 30, 1.0), ("gaussian", 0.1, 100, 1.0), ("gaussian", 3.0, 200, 1.0)]
    chosen += [("diffraction", 1.0, 80, 3.0)]
    return [
        Cell(flux, noise, profile, 1.0, elongation, SIDE, 1.0, 0.0, 1.0)
        for profile, noise, flux, elongation in chosen
    ]


def far_cases() -> list[Cell]:
    """Return cells whose spots come near the window's edge."""
    noise_and_flux = ((0.1, 30), (1.0, 30), (3.0, 80), (3.0, 200))
    return [Cell(flux, noise, "diffraction", 1.0, 1.0, SIDE, 4.0, 0.0, 1.0) for noise, flux in noise_and_flux]


def label(cell: Cell) -> str:
    """Return a cell's name in the tables."""
    elongated = f", {cell.elongation:g}x" if cell.elongation > 1 else ""
    far = f", ±{cell.position_range_px:g} px" if cell.position_range_px != 1 else ""
    return f"{cell.profile}{elongated}, {cell.read_noise_e:g} e-, {cell.flux_e:g} e-{far}"


def automatic(cell: Cell) -> tuple[float, int]:
    """Return strength and kept pixels of the rule."""
    fwhm_px = 2.0 if cell.profile == "gaussian" else 1.772
    known: dict[str, Any] = {
        "pixels": SIDE**2,
        "spot_fwhm_px": fwhm_px * np.sqrt(cell.elongation),
        "elongation": cell.elongation,
        "profile": cell.profile,
        "position_range_px": cell.position_range_px,
    }
    flux = (cell.flux_e, cell.read_noise_e)
    return float(automatic_strength(*flux, **known)), int(automatic_kept_pixels(*flux, **known))


def penalised_tv(images: Images, multiplier: float, iterations: int = 100, block: int = 128) -> Images:
    """Minimise ||u - g||^2 / 2 + multiplier * TV(u) of every image by FGP (Beck & Teboulle 2009)."""
    result = np.empty_like(images)
    for start in range(0, len(images), block):  # a block stays in the processor's cache
        # Images along the last axis: differences of rows and columns are then of contiguous memory.
        g = np.ascontiguousarray(np.moveaxis(images[start : start + block], 0, -1))
        p, q = np.zeros((2, 2, *g.shape), np.float32)  # the dual field and its extrapolation; [0] is along y
        momentum = 1.0
        for _ in range(iterations):
            u = g - multiplier * _adjoint(q)
            q[0, :-1] += (u[1:] - u[:-1]) / (8 * multiplier)
            q[1, :, :-1] += (u[:, 1:] - u[:, :-1]) / (8 * multiplier)
            q /= np.maximum(1.0, np.sqrt(q[0] ** 2 + q[1] ** 2))
            previous, momentum = momentum, (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            p, q = q, q + np.float32((previous - 1) / momentum) * (q - p)
        result[start : start + block] = np.moveaxis(g - multiplier * _adjoint(p), -1, 0)
    return result


def _adjoint(field: Images) -> Images:
    """Adjoint of forward differences (the negative divergence); the field's last row and column are 0."""
    result: Images = -(field[0] + field[1])
    result[1:] += field[0, :-1]
    result[:, 1:] += field[1, :, :-1]
    return result


def whole_frame_tv(images: Images, strength: float) -> Images:
    """Denoise every LENSLETS^2 images as one frame of sub-apertures side by side."""
    tiles = images.reshape(-1, LENSLETS, LENSLETS, SIDE, SIDE)
    frames = tiles.swapaxes(2, 3).reshape(-1, LENSLETS * SIDE, LENSLETS * SIDE)
    denoised = fs.tv_denoise(frames, strength).reshape(-1, LENSLETS, SIDE, LENSLETS, SIDE)
    return np.ascontiguousarray(denoised.swapaxes(2, 3)).reshape(images.shape)


def zero_border_tv(images: Images, strength: float) -> Images:
    """Denoise images with a border of zeros, one pixel wide, which takes its share of the noise."""
    framed = np.pad(images, ((0, 0), (1, 1), (1, 1)))
    return np.ascontiguousarray(fs.tv_denoise(framed, strength * SIDE / (SIDE + 2))[:, 1:-1, 1:-1])


class Method(NamedTuple):
    """A way to prepare images before the brightest pixels, and the parameters to choose from."""

    name: str
    candidates: tuple[float, ...]
    prepare: Callable[[Images, float, Cell], Images]


METHODS = (
    Method("no TV", (0.0,), lambda g, _, __: g),
    Method("TV, searched", STRENGTHS, lambda g, s, cell: fs.tv_denoise(g, s * cell.pixel_noise_e)),
    Method("penalised", MULTIPLIERS, lambda g, m, cell: penalised_tv(g, m * cell.pixel_noise_e)),
    Method("whole frame", STRENGTHS, lambda g, s, cell: whole_frame_tv(g, s * cell.pixel_noise_e)),
    Method("zero border", STRENGTHS, lambda g, s, cell: zero_border_tv(g, s * cell.pixel_noise_e)),
    Method("Gaussian", WIDTHS_PX, lambda g, w, _: gaussian_filter(g, w, mode="constant", axes=(-2, -1))),
)


def positions_of(images: Images, cell: Cell, kept: Any = KEPT) -> Floats:
    """Return positions (n, K, 2) for every number of kept pixels."""
    every_k, _ = position_table(BrightestPixels(), np.ascontiguousarray(images))
    return every_k[:, np.atleast_1d(kept) - 1]


def moments(positions: Floats, truth: Floats, groups: int = 1) -> Floats:
    """Return the sums (8, groups, ...) that `quantities` needs, of positions (n, ..., 2), truth (n, 2)."""
    true = truth.reshape(len(truth), *[1] * (positions.ndim - 2), 2)
    absolute = np.abs(positions - true).mean(axis=-1)
    squares = [np.sum(a * b, axis=-1) for a, b in ((positions, positions), (positions, true), (true, true))]
    first = [positions[..., 0], positions[..., 1], true[..., 0], true[..., 1]]
    parts = np.stack(np.broadcast_arrays(absolute, *first, *squares))
    sums: Floats = parts.reshape(8, groups, -1, *parts.shape[2:]).sum(axis=2)
    return sums


def quantities(sums: Floats, n: int) -> Floats:
    """Return R and the gain-corrected rms (2, ...) from `moments` (8, ...) of n slopes.

    As `faintspot.base.statistics.slope_statistics` defines them.
    """
    absolute, ex, ey, tx, ty, ee, et, tt = sums
    ee, et, tt = ee - (ex**2 + ey**2) / n, et - (ex * tx + ey * ty) / n, tt - (tx**2 + ty**2) / n
    gain = et / tt
    residual = np.sqrt(np.maximum(ee - gain * et, 0) / (2 * n))
    corrected = np.divide(residual, gain, out=np.full(np.shape(gain), np.inf), where=gain > 0)
    return np.stack([absolute / n, corrected])


def costs_of(positions: Floats, truth: Floats) -> Floats:
    """Return R and the gain-corrected rms (2, K) of positions (n, K, 2)."""
    return quantities(moments(positions, truth)[:, 0], len(truth))


def value(estimate: Floats, truth: Floats, which: int) -> str:
    """Return R or the gain-corrected rms with its standard error, px."""
    statistics = slope_statistics(estimate[:, 0], estimate[:, 1], truth)
    chosen = (statistics.error, statistics.corrected_rms)[which]
    return f"{chosen.value:.4f} ± {chosen.standard_error:.4f}"


def ratio(estimate: Floats, reference: Floats, truth: Floats, groups: int, which: int) -> str:
    """Return quantity `which` over that of the reference, ± the jackknife error over groups of slopes."""
    n = len(truth)
    both = [moments(positions, truth, groups) for positions in (estimate, reference)]
    whole, whole_reference = (quantities(m.sum(axis=1), n)[which] for m in both)
    fewer = n - n // groups
    left_out, left_out_reference = (quantities(m.sum(axis=1, keepdims=True) - m, fewer)[which] for m in both)
    spread = (left_out / left_out_reference).std() * np.sqrt(groups - 1)
    return f"{whole / whole_reference:.3f} ± {spread:.3f}"


def exposed(
    cell: Cell, flux_e: float | Floats, n: int, rng: Any, positions: Any = None
) -> tuple[Images, Floats]:
    """Return n images of the cell and the true positions of their spots."""
    return subapertures(
        n,
        shape=(SIDE, SIDE),
        flux_e=flux_e,
        profile=cell.profile,
        elongation=cell.elongation,
        position_range_px=cell.position_range_px,
        positions=positions,
        detector=Detector(read_noise_e=cell.read_noise_e),
        rng=rng,
    )


def compare_single_frames(cell: Cell, uneven: float, count: int, rng: np.random.Generator) -> list[list[str]]:
    """Return the row of each quantity's table; fluxes are uniform within 1 ± uneven of the cell's."""
    flux = cell.flux_e * rng.uniform(1 - uneven, 1 + uneven, (2, count))
    tuning, tuning_truth = exposed(cell, flux[0], count, rng)
    images, truth = exposed(cell, flux[1], count, rng)
    strength, kept = automatic(cell)
    reference = positions_of(fs.tv_denoise(images, strength), cell, kept)[:, 0]
    name = label(cell) + (", uneven" if uneven else "")
    rows = [[name, value(reference, truth, which)] for which in range(len(QUANTITIES))]
    bordered = positions_of(zero_border_tv(images, strength), cell, kept)[:, 0]
    n_frames = count // LENSLETS**2
    for which, row in enumerate(rows):
        row.append(ratio(bordered, reference, truth, n_frames, which))
    for method in METHODS:
        tables = (positions_of(method.prepare(tuning, c, cell), cell) for c in method.candidates)
        costs = np.stack([costs_of(table, tuning_truth) for table in tables], axis=1)
        for which, row in enumerate(rows):
            candidate, k = np.unravel_index(np.argmin(costs[which]), costs[which].shape)
            prepared = method.prepare(images, method.candidates[candidate], cell)
            measured = positions_of(prepared, cell, KEPT[k])[:, 0]
            row.append(ratio(measured, reference, truth, n_frames, which))
            row[-1] += f" ({method.candidates[candidate]:g}, {KEPT[k]})"
    return rows


def moving_frames(cell: Cell, rho: float, count: int, rng: np.random.Generator) -> tuple[Images, Floats]:
    """Return sequences (m, frames, side, side) of spots that move, and true positions (m, frames, 2)."""
    steps = rng.standard_normal((count // SCORED, SETTLING + SCORED, 2)) * MOTION_PX
    for t in range(1, steps.shape[1]):
        steps[:, t] = rho * steps[:, t - 1] + np.sqrt(1 - rho**2) * steps[:, t]
    images, _ = exposed(cell, cell.flux_e, steps[..., 0].size, rng, steps.reshape(-1, 2))
    return images.reshape(*steps.shape[:2], SIDE, SIDE), steps


class Temporal(NamedTuple):
    """How frames are put together: every combination of frames added up, TV strengths and gains is tried."""

    name: str
    frames: tuple[int, ...]
    strengths: tuple[float, ...]
    gains: tuple[float, ...]


TEMPORAL = (
    Temporal("no TV, smoothed slopes", (1,), (0.0,), GAINS),
    Temporal("TV, newest frame", (1,), MOVING_STRENGTHS, (1.0,)),
    Temporal("2 or 3 frames, no TV", (2, 3), (0.0,), (1.0,)),
    Temporal("2 or 3 frames, TV", (2, 3), MOVING_STRENGTHS, (1.0,)),
    Temporal("TV, smoothed slopes", (1,), MOVING_STRENGTHS, GAINS),
)


def moving_positions(images: Images, cell: Cell, frames: int, strength: float, whole: bool) -> Floats:
    """Return positions (m, frames, K, 2) of sums of successive frames, of whole sequences or the scored."""
    used = images if whole else images[:, SETTLING - frames + 1 :]
    last = used.shape[1]
    added = sum(used[:, i : last - frames + 1 + i] for i in range(frames))
    stack = np.asarray(added, np.float32).reshape(-1, SIDE, SIDE)
    if strength:
        stack = fs.tv_denoise(stack, strength * np.sqrt(frames) * cell.pixel_noise_e)
    return positions_of(stack, cell).reshape(len(images), -1, len(KEPT), 2)


def smoothed(positions: Floats, gain: float) -> Floats:
    """Return the scored frames (m * SCORED, ..., 2) of exponentially smoothed positions."""
    result = positions.copy()
    if gain < 1:
        for t in range(1, result.shape[1]):
            result[:, t] = result[:, t - 1] + gain * (positions[:, t] - result[:, t - 1])
    return result[:, -SCORED:].reshape(-1, *positions.shape[2:])


def compare_moving_frames(cell: Cell, rho: float, count: int, rng: np.random.Generator) -> list[list[str]]:
    """Return the row of each quantity's table."""
    tuning, tuning_motion = moving_frames(cell, rho, count, rng)
    images, motion = moving_frames(cell, rho, count, rng)
    tuning_truth, truth = (m[:, -SCORED:].reshape(-1, 2) for m in (tuning_motion, motion))
    rows, references = [[label(cell), f"{rho:g}"] for _ in QUANTITIES], [truth, truth]
    for method in TEMPORAL:
        candidates = list(product(method.frames, method.strengths))
        filtered = len(method.gains) > 1
        tables = (moving_positions(tuning, cell, *c, filtered) for c in candidates)
        costs = np.stack(
            [[costs_of(smoothed(table, g), tuning_truth) for g in method.gains] for table in tables], axis=2
        )  # (gain, quantity, candidate, k)
        for which, row in enumerate(rows):
            cost = costs[:, which]
            best, candidate, k = np.unravel_index(np.argmin(cost), cost.shape)
            gain, (frames, strength) = method.gains[best], candidates[candidate]
            table = moving_positions(images, cell, frames, strength, filtered)
            measured = smoothed(table[:, :, k], gain)
            if method is TEMPORAL[0]:
                references[which] = measured
                row.append(value(measured, truth, which))
            else:
                row.append(ratio(measured, references[which], truth, len(images), which))
            row[-1] += f" ({frames}, {strength:g}, {gain:g}, {KEPT[k]})"
    return rows


def print_tables(title: str, head: list[str], tables: list[list[list[str]]]) -> None:
    """Print a table for each quantity from the rows of each case."""
    for which, quantity in enumerate(QUANTITIES):
        print(f"\n{title}: {quantity}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
        for rows in tables:
            print(f"| {' | '.join(rows[which])} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--realisations", type=int, default=1960, help="of each sample; default %(default)s")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    count = max(2, arguments.realisations // LENSLETS**2) * LENSLETS**2
    rng = np.random.default_rng(arguments.seed)
    head = ["case", "TV, automatic", "zero border, automatic", *(method.name for method in METHODS)]
    frames = [(cell, 0.0) for cell in [*cases(), *far_cases()]] + [(cell, UNEVEN) for cell in cases()[4:9]]
    print_tables("Single frames", head, [compare_single_frames(*case, count, rng) for case in frames])
    head = ["case", "correlation", *(method.name for method in TEMPORAL)]
    moving = [compare_moving_frames(cell, rho, count, rng) for cell in cases() for rho in CORRELATIONS]
    print_tables("Moving spots", head, moving)


if __name__ == "__main__":
    main()
