"""The basis of a trained score's tables."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from faintspot.slopes.spots.score import table_sums
from faintspot.slopes.training.splines import (
    STEPS_PER_PX,
    SYMMETRIES,
    SplineTables,
    cubic_b_spline,
    splines_for,
)


def test_is_the_cubic_b_spline() -> None:
    at = np.linspace(-3, 3, 61)
    expected = np.nan_to_num(BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)(at))
    np.testing.assert_allclose(cubic_b_spline(at), expected, atol=1e-14)


@pytest.mark.parametrize("spacing", [0.5, 1.0])
def test_even_functions_hold_a_constant(spacing: float) -> None:
    _, even = SplineTables(spacing, 6, "round").odd_and_even()
    middle = len(even) // 2
    inside = int(4 * spacing * STEPS_PER_PX)
    np.testing.assert_allclose(even.sum(axis=1)[middle - inside : middle + inside + 1], 1.0)


@given(
    symmetry=st.sampled_from(SYMMETRIES),
    spacing=st.sampled_from([0.5, 1.0]),
    shape=st.sampled_from([(8, 8), (7, 10)]),
    seed=st.integers(0, 1000),
)
def test_features_are_sums_over_tables(
    symmetry: str, spacing: float, shape: tuple[int, int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    basis = SplineTables(spacing, 4, symmetry)
    images = rng.standard_normal((3, *shape))
    rounded = rng.integers(-20, 20, (3, 2)) / STEPS_PER_PX
    weights = rng.standard_normal((2, basis.n_features))
    features = basis.features(images, rounded)
    expected = np.stack([part @ weight for part, weight in zip(features, weights, strict=True)], axis=1)
    tables = basis.tables(*weights)
    # Tables are float32: about 1e-7 of weights of order 1 in sums of up to 70 pixels.
    np.testing.assert_allclose(table_sums(images, rounded, tables, STEPS_PER_PX), expected, atol=1e-4)
    assert tables.shape[1] % 2 == 1
    np.testing.assert_allclose(tables, -tables[:, ::-1, ::-1], atol=1e-6)
    if symmetry != "point":
        np.testing.assert_allclose(tables[0], tables[0, ::-1], atol=1e-6)


def test_no_wider_than_needed() -> None:
    assert splines_for(1.0, 30.0, "round").n_nodes == 8
    assert splines_for(0.5, 30.0, "round").n_nodes == 12
    assert splines_for(0.5, 3.2, "round").n_nodes == 7
