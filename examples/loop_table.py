"""What the examples with other tools share: every method is tuned on other air than it is judged by."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np


def compare(
    methods: Mapping[str, Sequence[Any]],
    strehl: Callable[[Any, float, int], float],
    gains: Sequence[float],
    *,
    tuning: Sequence[int] = (1, 2),
    every_k: Sequence[int] = (11, 12, 13, 14),
    score: str = "Strehl ratio",
) -> None:
    """Print a table: the score of every method, its standard error over pieces of air, and against the first.

    Parameters
    ----------
    methods : mapping
        By name, the setups to choose from; the first method is what all are compared with.
    strehl : callable
        Closes the loop with a setup, a gain and the air of a seed.
    gains : sequence of float
    tuning, scoring : sequence of int
        Seeds of the air that setups and gains are chosen on, and of that which is scored.
    score : str
        What `strehl` returns, more being better.
    """
    first: np.ndarray | None = None
    print(f"{'':34s} {score:16s} against the first  chosen, loop gain")
    for name, setups in methods.items():
        begun = time.perf_counter()
        tried = [
            (np.mean([strehl(setup, gain, seed) for seed in tuning]), number, gain)
            for number, setup in enumerate(setups)
            for gain in gains
        ]
        _, number, gain = max(tried)
        scores = np.array([strehl(setups[number], gain, seed) for seed in every_k])
        first = scores if first is None else first
        rows = scores, scores - first
        errors = [row.std(ddof=1) / np.sqrt(len(row)) for row in rows]
        print(
            f"{name:34s} {scores.mean():.3f} +- {errors[0]:.3f}  {rows[1].mean():+.3f} +- {errors[1]:.3f}"
            f"    {setups[number]}, {gain:g}   ({time.perf_counter() - begun:.0f} s)",
            flush=True,
        )


def by_commands(interaction: np.ndarray, commands: Callable[[], tuple[Any, Any]]) -> Callable[[Any], Any]:
    """Return what predicts slopes of an integrator that is late: those of what acts less what it asks for.

    The latest command is what the loop knows of the air; until it acts, the difference is seen.

    Parameters
    ----------
    interaction : (slopes, commands) array
    commands : callable
        Gives the command that acts on the frame to come, and the latest one.
    """

    def predict(slopes: Any) -> Any:
        acting, latest = commands()
        return interaction @ (acting - latest)

    return predict
