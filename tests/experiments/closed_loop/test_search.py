"""The search for the best options."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from faintspot.experiments.closed_loop.methods import Choice
from faintspot.experiments.closed_loop.search import coordinate_search, corrected_badness


def test_choice_follows_the_axes_to_the_minimum() -> None:
    axes = {"a": [0.0, 1.0, 2.0], "b": [0.0, 1.0, 2.0]}

    def badness(choice: Choice, name: str, values: Sequence[float]) -> list[float]:
        each = [{**choice, name: value} for value in values]
        return [(one["a"] - 2) ** 2 + 0.1 * (one["b"] - one["a"]) ** 2 for one in each]

    assert coordinate_search(axes, badness) == {"a": 2.0, "b": 2.0}


def test_one_axis_is_looked_at_once_and_none_not_at_all() -> None:
    looks = []

    def badness(choice: Choice, name: str, values: Sequence[str]) -> list[float]:
        looks.append(name)
        return [3.0, 1.0, 2.0]

    assert coordinate_search({"rule": ["x", "y", "z"]}, badness) == {"rule": "y"}
    assert coordinate_search({}, badness) == {}
    assert looks == ["rule"]


def test_what_measures_nothing_is_behind_all_that_measures_something() -> None:
    truth = np.random.default_rng(1).uniform(-1, 1, (200, 2))
    noise = np.random.default_rng(2).normal(0, 3, (2, 200))
    nothing = corrected_badness(np.zeros(200), np.zeros(200), truth)
    assert nothing > 1e5
    assert corrected_badness(truth[:, 0] + noise[0], truth[:, 1] + noise[1], truth) < 1e3
    half = corrected_badness(0.5 * truth[:, 0], 0.5 * truth[:, 1], truth)
    assert half == pytest.approx(0.0, abs=1e-7)
