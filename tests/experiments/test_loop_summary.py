from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faintspot.experiments.budget import TERMS
from faintspot.experiments.loop_results import BudgetResult, MagnitudeResult
from faintspot.experiments.loop_verdict import budget_summary, magnitude_summary


@pytest.fixture
def result() -> MagnitudeResult:
    """TV denoising is 0.01 worse than brightest pixels everywhere, give or take 0.002."""
    atmosphere = np.array([-0.1, 0.0, 0.1, 0.05, -0.05])
    brightest = np.array([0.2, 0.4, 0.6])[:, None] + atmosphere
    tv = brightest - 0.01 + 0.002 * np.array([1, -1, 0, 1, -1])
    return MagnitudeResult(
        ("brightest", "tv"),
        ("brightest pixels", "TV denoising"),
        np.array([10.0, 40.0, 160.0]),
        np.array([13.0, 11.5, 10.0]),
        np.stack([brightest, tv]),
        np.ones((2, 3, 5)),
        np.full((2, 3), ""),
        np.full((2, 3), '{"loop_gain": 0.5}'),
        np.ones((2, 3, 5, 5), np.float32),
        "",
    )


def test_magnitude(result: MagnitudeResult) -> None:
    lines = magnitude_summary(result).splitlines()
    assert lines[0].split() == ["photo-electrons", "10", "40", "160"]
    assert lines[1].split() == ["magnitude", "13.0", "11.5", "10.0"]
    error = np.std([-0.1, 0.0, 0.1, 0.05, -0.05], ddof=1) / np.sqrt(5)
    assert lines[2].split() == ["brightest", "pixels", "0.200", f"±{error:.3f}", "0.400", f"±{error:.3f}",
                                "0.600", f"±{error:.3f}"]  # fmt: skip
    assert any(line.startswith("TV raises the Strehl ratio nowhere beyond its error") for line in lines)


def test_one_realisation_has_no_error(result: MagnitudeResult) -> None:
    single = replace(result, strehl=result.strehl[:, :, :1], centroid_gain=result.centroid_gain[:, :, :1])
    text = magnitude_summary(single)
    assert "nan" not in text
    assert "0.100 ±?" in text


def test_two_realisations_name_no_gain(result: MagnitudeResult) -> None:
    """Not a figure of a gain whose error is not known."""
    few = replace(result, strehl=result.strehl[:, :, :2], centroid_gain=result.centroid_gain[:, :, :2])
    text = " ".join(magnitude_summary(few).split())
    assert "gain in limiting magnitude: too few realisations for an interval" in text
    assert " mag." not in text


def test_budget() -> None:
    shape = (1, len(TERMS), 3)
    strehl = np.broadcast_to(np.linspace(0.3, 0.9, len(TERMS))[:, None], shape)
    residual = np.full(shape, 150.0)
    result = BudgetResult(("brightest",), tuple(TERMS), ("brightest pixels",), strehl, residual)
    lines = budget_summary(result).splitlines()
    assert lines[1].split() == ["nothing", "0.300", "±0.000", "150", "±0", "nm"]
    assert "without slope error: slopes are the mean gradients of the wavefront" in lines
