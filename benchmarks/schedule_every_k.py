"""How far the preset "accurate" is from the converged slope error with every number of kept pixels.

The reference cases at the strength that suits each, on which the preset was chosen (with other random
numbers), and cases that had no part in it, at 0.3 to 0.7 of a mean pixel's noise.

    python -m benchmarks.schedule_every_k [--realisations 1500]
"""

from __future__ import annotations

import click
import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks import showing
from benchmarks.measuring import Row, Table
from benchmarks.schedule_cases import CASES, ENOUGH, Case, case_of, sample
from faintspot.estimators.gravity import FLUX_FLOOR
from faintspot.kernels import scoring

_FEWEST = 5
_MANY = 100 / 255  # of the pixels: what anybody might keep
_OTHERS = (
    (case_of("gauss", 0.1, 80, profile="gaussian"), 0.3),
    (case_of("gauss_size1.5", 0.1, 80, profile="gaussian", size=1.5), 0.3),
    (case_of("gauss_size1.3", 0.5, 150, profile="gaussian", size=1.3), 0.4),
    (case_of("20px", 0.2, 60, pixels=20), 0.5),
    (case_of("size1.3", 0.2, 120, size=1.3), 0.6),
    (case_of("long2", 0.3, 150, elongation=2), 0.4),
    (case_of("rn2", 2, 150), 0.7),
)


def errors_of_every_k(images: NDArray[np.float32], truth: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return (|dx| + |dy|) / 2 of images, (n, number of pixels - 1)."""
    flat = np.ascontiguousarray(images.reshape(len(images), -1))
    errors = np.empty((len(flat), flat.shape[1] - 1), np.float32)
    scoring.errors_of_every_k(
        flat,
        images.shape[-1],
        scoring.SUBTRACT_NEXT,
        FLUX_FLOOR,
        np.inf,
        truth,
        0,
        len(flat),
        errors,
        np.empty(errors.shape, np.bool_),
    )
    return errors


def row_of(case: Case, strength: float, realisations: int, number: int) -> Row:
    """Excess over the converged R, %: at the best k, and the largest of k up to 39 % and of all."""
    images, truth = sample(case, realisations, number, 23)
    noise_std = strength * case.pixel_noise_e
    made = fs.tv_denoise(images, noise_std, lower_strength=True)
    exact = fs.tv_denoise(images, noise_std, tolerance=1e-6, max_iterations=2000, lower_strength=True)
    ours, theirs = errors_of_every_k(made, truth), errors_of_every_k(exact, truth)
    error = theirs.mean(axis=0, dtype=np.float64)
    excess = ours.mean(axis=0, dtype=np.float64) / error - 1
    standard_error = ((ours - (1 + excess) * theirs) / error).std(axis=0) / np.sqrt(len(images))
    values = {"at the best k %": 100 * float(excess[error.argmin()])}
    for name, last in (("k to 39 %", round(_MANY * len(error))), ("all k", len(error))):
        part = slice(_FEWEST - 1, last)
        worst = _FEWEST - 1 + int(excess[part].argmax())
        values[f"{name}: worst %"] = 100 * float(excess[worst])
        values[f"{name}: +- %"] = 100 * float(standard_error[worst])
        values[f"{name}: k"] = worst + 1.0
        values[f"{name}: surely"] = float(np.any((excess - 2 * standard_error)[part] > ENOUGH))
    return Row(f"{case.name}, {strength:g}", values)


def summary(rows: list[Row]) -> str:
    """Say the worst and the median of all rows, and in how many R is surely more than 1 % above."""
    said = []
    for name in ("k to 39 %", "all k"):
        worst = [row.values[f"{name}: worst %"] for row in rows]
        surely = sum(row.values[f"{name}: surely"] for row in rows)
        said.append(
            f"{name}: worst {max(worst):.1f} %, median {np.median(worst):.2f} %, "
            f"surely above {100 * ENOUGH:g} % in {surely:.0f} of {len(rows)}"
        )
    return "; ".join(said)


@click.command()
@click.option("--realisations", type=int, default=1500, show_default=True)
def main(realisations: int) -> None:
    """Print both tables."""
    reference = [(case, case.best) for case in CASES if case.best is not None]
    others = [*_OTHERS, *((case, 0.7) for case in CASES if not case.is_reference)]
    for title, cells in (("The reference cases", reference), ("Other cases", others)):
        rows = [row_of(case, strength, realisations, i) for i, (case, strength) in enumerate(cells)]
        showing.show(Table("every_k", title, rows, [summary(rows)]))


if __name__ == "__main__":
    main()
