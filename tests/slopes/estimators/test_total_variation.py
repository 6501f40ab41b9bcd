from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from tests import naive
from tests.patience import mostly_slow
from tests.refusals import assert_each_refused, refused
from tests.slopes.estimators.image_cases import images, largest, spread

import faintspot as fs

ALGORITHMS = ("fgp", "chambolle")
DTYPES = (np.float32, np.float64)
KERNELS = [(np.float32, "fgp"), (np.float64, "chambolle"), (np.float64, "fgp"), (np.float32, "chambolle")]
# Rounding: the kernels stay within 5 epsilon of max|g| on ordinary images. Outliers, 64 x 64 pixels and
# strengths near the image's own rms add a factor.
ROUNDINGS = 60
# A convergence test whose two sides are nearer than this may go either way by rounding.
MARGIN = 1e-3

fractions = st.one_of(st.just(0.0), st.floats(1e-3, 0.98), st.sampled_from([0.98, 1.02, 1.5, 1e3]))
every_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS)
every_kernel = pytest.mark.parametrize(("dtype", "algorithm"), mostly_slow(2, KERNELS))
every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def tolerance_of(dtype: Any) -> float:
    return ROUNDINGS * float(np.finfo(dtype).eps)


def rounding_of(g: Any, dtype: Any) -> float:
    """What rounding may leave of a denoised image, in units of its largest pixel."""
    size: int = max(g.shape)
    return 50 * max(1.0, (size / 12) ** 2) * tolerance_of(dtype)


def strengths_of(stack: Any, fraction: float) -> Any:
    """Strengths relative to the images' own rms; of constant images, relative to one of them."""
    rms = spread(stack)
    return fraction * np.where(rms > 1e-6 * largest(stack), rms, largest(stack))


class TestAgainstOracle:
    @pytest.mark.slow
    @every_dtype
    @every_algorithm
    @given(images(), fractions, st.sampled_from([1, 2, 7, 40]))
    def test_same_image_after_any_number_of_iterations(
        self, algorithm: str, dtype: Any, stack: Any, fraction: float, iterations: int
    ) -> None:
        """The potential that the start is the gradient of grows as the square of the image's side; so does
        what rounding leaves of its differences.
        """
        stack = stack.astype(dtype)
        strength = strengths_of(stack, fraction)
        result = fs.tv_denoise(
            stack, strength, algorithm=algorithm, tolerance=0, max_iterations=iterations, full_output=True
        )
        assert result.images.dtype == dtype
        for i, g in enumerate(stack):
            expected = naive.tv_denoise(g, strength[i], algorithm, 0.0, iterations)
            # Ranges whose inverse overflows float32 count as constant: nothing changes by more than 1e-30.
            bound = rounding_of(g, dtype) * largest(g) + 1e-29
            assert np.max(np.abs(result.images[i] - expected.image)) <= bound
            if largest(g) > 1e-20:
                assert result.iterations[i] == expected.iterations
                assert result.infeasible[i] == expected.infeasible
                assert result.converged[i] == expected.converged
                assert np.isclose(result.multiplier[i], expected.multiplier, rtol=100 * tolerance_of(dtype))

    @pytest.mark.slow
    @every_dtype
    @every_algorithm
    @given(images(), st.floats(0.05, 0.98), st.sampled_from([1e-3, 1e-2, 0.3]))
    def test_stops_at_the_same_iteration(
        self, algorithm: str, dtype: Any, stack: Any, fraction: float, tolerance: float
    ) -> None:
        stack = stack.astype(dtype)
        strength = strengths_of(stack, fraction)
        expected = [
            naive.tv_denoise(g, s, algorithm, tolerance, 60) for g, s in zip(stack, strength, strict=True)
        ]
        assume(all(e.margin > MARGIN for e in expected) and largest(stack).max() > 1e-20)
        result = fs.tv_denoise(
            stack, strength, algorithm=algorithm, tolerance=tolerance, max_iterations=60, full_output=True
        )
        assert result.iterations.tolist() == [e.iterations for e in expected]
        assert result.converged.tolist() == [e.converged for e in expected]

    @pytest.mark.parametrize("width", ["3", "32", "wide", ""])
    def test_refuses_other_simd_widths(self, width: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("FAINTSPOT_SIMD_WIDTH", width)
        with refused("FAINTSPOT_SIMD_WIDTH", "4, 8 or 16"):
            fs.tv_denoise(np.eye(4, dtype=np.float32), 0.1)


class TestSolution:
    """What holds for the minimum whatever the algorithm."""

    @every_dtype
    @given(images(), st.floats(0.01, 0.98), st.integers(1, 30))
    def test_constraint_holds_to_rounding_after_any_iteration(
        self, dtype: Any, stack: Any, fraction: float, iterations: int
    ) -> None:
        stack = stack.astype(dtype)
        feasible = spread(stack) > 1e-3 * largest(stack) + 1e-20
        strength = strengths_of(stack, fraction)
        u = fs.tv_denoise(stack, strength, max_iterations=iterations)
        scale = np.where(feasible, largest(stack), 1.0)
        moved = (u.astype(np.float64) - stack) / scale[:, None, None]
        rms = np.sqrt(np.mean(moved**2, axis=(1, 2)))
        error = np.abs(rms - strength / scale)
        assert np.all(error[feasible] <= tolerance_of(dtype))

    @every_algorithm
    def test_is_the_minimum_of_the_penalised_problem(self, algorithm: str) -> None:
        """u minimises ||u - g||^2 / 2 + lambda TV(u) exactly when v = (g - u) / lambda has <v, u> = TV(u)
        and <v, w> <= TV(w) for every w; the duality gap is lambda (TV(u) - <v, u>).
        """
        rng = np.random.default_rng(2)
        for shape in ((2, 2), (3, 9), (8, 8), (11, 5)):
            g = rng.normal(size=shape) + 4 * np.exp(-(np.linspace(-2, 2, shape[0])[:, None] ** 2))
            result = fs.tv_denoise(
                g, 0.7 * g.std(), algorithm=algorithm, tolerance=0, max_iterations=20_000, full_output=True
            )
            u, multiplier = result.images, float(result.multiplier)
            v = (g - u) / multiplier
            gap = naive.total_variation(u) - np.sum(v * u)
            # The fixed point converges like 1 / iterations, the accelerated solver like 1 / iterations^2.
            assert abs(gap) <= (1e-6 if algorithm == "fgp" else 1e-3) * naive.total_variation(g)
            for w in (*rng.normal(size=(200, *shape)), g, u, u**2, rng.random(shape) < 0.5):
                w = np.asarray(w, float)
                assert np.sum(v * w) <= naive.total_variation(w) * (1 + 1e-9)


class TestSpecialCases:
    @every_dtype
    @pytest.mark.parametrize("strength", [0.0, 0.5, 1e10])
    def test_constant_images_return_themselves(self, dtype: Any, strength: float) -> None:
        values = np.array([0.0, 1.0, -3.5, 1e25, -1e-30, 1e-42], dtype)
        g = np.broadcast_to(values[:, None, None], (6, 5, 4)).copy()
        result = fs.tv_denoise(g, strength, full_output=True)
        assert np.array_equal(result.images, g)
        assert np.all(result.iterations == 0)
        assert result.converged.all()
        assert np.all(result.infeasible == (strength > 0))
        assert np.all(result.multiplier == (np.inf if strength else 0.0))

    @every_dtype
    def test_infeasible_strength_returns_the_mean(self, dtype: Any) -> None:
        g = np.random.default_rng(6).normal(size=(6, 7, 5)).astype(dtype)
        result = fs.tv_denoise(g, spread(g) * 1.001, full_output=True)
        assert result.infeasible.all()
        assert result.converged.all()
        assert np.all(result.iterations == 0)
        assert np.all(np.isposinf(result.multiplier))
        assert np.all(np.ptp(result.images, axis=(1, 2)) == 0.0)
        assert np.allclose(result.images[:, 0, 0], g.mean(axis=(1, 2)), atol=10 * np.finfo(dtype).eps)

    @every_kernel
    @given(images(), st.sampled_from([1 - 1e-3, 1 - 1e-6, 1.0, 1 + 1e-6]))
    def test_at_the_edge_of_feasibility_everything_is_finite(
        self, algorithm: str, dtype: Any, stack: Any, fraction: float
    ) -> None:
        stack = stack.astype(dtype)
        result = fs.tv_denoise(
            stack, spread(stack) * fraction, algorithm=algorithm, full_output=True, max_iterations=25
        )
        assert np.isfinite(result.images).all()
        assert not np.isnan(result.multiplier).any()
        assert np.all(largest(result.images) <= 3 * largest(stack) + 1e-29)

    @every_dtype
    def test_subnormal_images_and_strengths(self, dtype: Any) -> None:
        rng = np.random.default_rng(7)
        tiny = np.finfo(dtype).smallest_normal
        g = (rng.normal(size=(4, 5, 5)) * float(tiny) * np.array([1e-3, 0.1, 1, 10])[:, None, None]).astype(
            dtype
        )
        u = fs.tv_denoise(g, float(tiny) * 0.1)
        assert np.all(np.abs(u - g) <= 30 * float(tiny))
        assert np.array_equal(fs.tv_denoise(np.eye(4, dtype=dtype), 5e-324), np.eye(4, dtype=dtype))

    def test_largest_values_allowed(self) -> None:
        for dtype, limit in ((np.float32, 1e30), (np.float64, 1e290)):
            g = (np.random.default_rng(8).uniform(-1, 1, (3, 6, 6)) * limit * 0.999).astype(dtype)
            u = fs.tv_denoise(g, 0.3 * limit)
            scaled = [naive.tv_denoise(image / limit, 0.3).image for image in g.astype(np.float64)]
            assert np.allclose(u / limit, scaled, atol=tolerance_of(dtype))


class TestTooStrong:
    """Strengths that are lowered because the image's own rms is hardly larger, or smaller."""

    @every_kernel
    @given(images(), st.sampled_from([0.5, 0.899, 0.901, 1.0, 3.0, 1e30]))
    def test_is_what_the_lowered_strength_gives(
        self, algorithm: str, dtype: Any, stack: Any, fraction: float
    ) -> None:
        stack = stack.astype(dtype)
        strength = spread(stack) * fraction
        how: Any = {"algorithm": algorithm, "tolerance": 0, "max_iterations": 8}
        result = fs.tv_denoise(stack, strength, lower_strength=True, full_output=True, **how)
        for i, g in enumerate(stack):
            expected = naive.tv_denoise(g, strength[i], algorithm, 0.0, 8, lower=True)
            bound = rounding_of(g, dtype) * largest(g) + 1e-29
            assert np.max(np.abs(result.images[i] - expected.image)) <= bound
            if largest(g) > 1e-20:
                assert result.iterations[i] == expected.iterations
                assert result.infeasible[i] == expected.infeasible
                assert expected.infeasible == (fraction > 0.9) or np.ptp(g) == 0

    def test_nothing_changes_below(self) -> None:
        g = np.random.default_rng(10).normal(size=(20, 9, 9))
        strength = 0.89 * spread(g)
        plain = fs.tv_denoise(g, strength, full_output=True)
        lowered = fs.tv_denoise(g, strength, lower_strength=True, full_output=True)
        assert all(np.array_equal(a, b) for a, b in zip(plain, lowered, strict=True))


class TestArguments:
    def test_leading_dimensions_are_kept(self) -> None:
        g = np.random.default_rng(9).normal(size=(3, 4, 6, 5)).astype(np.float32)
        whole = fs.tv_denoise(g, 0.5, full_output=True)
        assert whole.images.shape == (3, 4, 6, 5)
        for field in ("iterations", "multiplier", "converged", "infeasible"):
            assert getattr(whole, field).shape == (3, 4)
        rows = fs.tv_denoise(g[1], 0.5, full_output=True)
        assert np.array_equal(rows.images, whole.images[1])
        assert rows.iterations.shape == (4,)
        single = fs.tv_denoise(g[1, 2], 0.5, full_output=True)
        assert np.array_equal(single.images, whole.images[1, 2])
        assert single.multiplier.shape == ()
        assert float(single.multiplier) == whole.multiplier[1, 2]

    def test_strength_broadcasts_to_the_leading_shape(self) -> None:
        g = np.random.default_rng(10).normal(size=(3, 4, 5, 5))
        strengths = np.array([0.2, 0.5, 0.0, 3.0])
        together = fs.tv_denoise(g, strengths)
        for i in range(3):
            for j in range(4):
                assert np.array_equal(together[i, j], fs.tv_denoise(g[i, j], strengths[j]))
        by_row = fs.tv_denoise(g, strengths[:3, None])
        assert np.array_equal(by_row[1, 3], fs.tv_denoise(g[1, 3], strengths[1]))

    def test_inputs_of_every_form(self) -> None:
        g = np.random.default_rng(11).integers(0, 200, (2, 5, 6))
        expected = fs.tv_denoise(g.astype(np.float64), 20.0)
        assert np.array_equal(fs.tv_denoise(g.tolist(), 20), expected)
        assert np.array_equal(fs.tv_denoise(g.astype(np.uint8), [20, 20]), expected)
        assert np.array_equal(fs.tv_denoise(g.astype(">i4"), np.int8(20)), expected)
        assert np.array_equal(fs.tv_denoise(np.asfortranarray(g), 20.0), expected)
        wide = np.repeat(g, 2, axis=2).astype(np.float64)
        assert np.array_equal(fs.tv_denoise(wide[:, :, ::2], 20.0), expected)
        assert fs.tv_denoise(g.astype(np.float16), 20.0).dtype == np.float32
        assert fs.tv_denoise(g > 100, 0.1).dtype == np.float64

    def test_inputs_stay_as_they_are(self) -> None:
        g = np.random.default_rng(12).normal(size=(5, 6, 6)).astype(np.float32)
        strengths = np.full(5, 0.5)
        copies = g.copy(), strengths.copy()
        g.flags.writeable = strengths.flags.writeable = False
        for strength in (strengths, 0.0, 50.0):
            result = fs.tv_denoise(g, strength)
            assert not np.shares_memory(result, g)
        assert np.array_equal(g, copies[0])
        assert np.array_equal(strengths, copies[1])

    def test_denoising_refuses_wrong_arguments(self) -> None:
        assert_each_refused(
            partial(fs.tv_denoise, np.ones((3, 4, 4)), noise_std=0.5),
            noise_std=[-0.1, np.nan, np.inf, [0.1, 0.2], np.ones((3, 1)), "strong", None, 1j, []],
            algorithm=["newton", None, ["fgp"]],
            tolerance=[-1e-3, np.nan, [0.1, 0.2]],
            max_iterations=[0, 2.5, np.inf, "many"],
        )
        narrow = [np.ones(shape) for shape in ((1, 5), (5, 1), (1, 1), (3, 1, 4))]
        assert_each_refused(partial(fs.tv_denoise, noise_std=0.5), images=narrow)


class TestIndependence:
    """Results do not depend on which images share a group or a thread, bitwise."""

    @every_kernel
    @given(images(count=20), st.integers(0, 2**32 - 1))
    def test_of_the_company(self, algorithm: str, dtype: Any, stack: Any, seed: int) -> None:
        stack = stack.astype(dtype)
        rng = np.random.default_rng(seed)
        strength = spread(stack) * rng.uniform(0.0, 1.2, len(stack))

        def denoise(select: Any) -> Any:
            return fs.tv_denoise(
                stack[select], strength[select], algorithm=algorithm, max_iterations=33, full_output=True
            )

        whole = denoise(slice(None))
        order = rng.permutation(len(stack))
        subset = rng.choice(len(stack), 7, replace=False)
        for select in (order, subset, [3], slice(1, None)):
            part = denoise(select)
            for field in ("images", "iterations", "multiplier", "converged", "infeasible"):
                assert np.array_equal(getattr(part, field), getattr(whole, field)[select]), field

    @every_dtype
    def test_several_threads_give_the_same_images(self, dtype: Any) -> None:
        stack = np.random.default_rng(16).normal(size=(1200, 4, 5)).astype(dtype)
        strengths = np.linspace(0, 1.1, len(stack))
        whole = fs.tv_denoise(stack, strengths)  # enough groups for several threads
        for start in range(0, len(stack), 150):  # too few for a second one
            part = slice(start, start + 150)
            assert np.array_equal(fs.tv_denoise(stack[part], strengths[part]), whole[part])

    def test_called_from_several_threads_at_once(self) -> None:
        from concurrent.futures import ThreadPoolExecutor

        rng = np.random.default_rng(17)
        stacks = [rng.normal(size=(50, *shape)).astype(np.float32) for shape in ((5, 5), (8, 3), (5, 5))] * 4
        expected = [fs.tv_denoise(stack, 0.5) for stack in stacks]
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda stack: fs.tv_denoise(stack, 0.5), stacks))
        assert all(np.array_equal(a, b) for a, b in zip(results, expected, strict=True))
