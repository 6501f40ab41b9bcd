from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import examples
from tests.pipeline_cases import FIELDS, assert_equals_oracle, assert_same, random_case
from tests.refusals import assert_each_refused, refused

import faintspot as fs

Flag = fs.SubapertureFlag
DTYPES = ("uint8", "uint16", "int16", "int32", "float32", "float64", ">u2", ">f4", ">f8", "<f2")


class TestAgainstOracle:
    @pytest.mark.parametrize("dtype", DTYPES)
    @given(seed=st.integers(0, 2**32 - 1))
    @examples(2)
    def test_random_sensors_equal_the_oracle(self, dtype: str, seed: int) -> None:
        case = random_case(seed, dtype)
        assert_equals_oracle(case, case.pipeline()(case.frame))

    @pytest.mark.slow
    @given(seed=st.integers(0, 2**32 - 1))
    def test_random_sensors_with_the_other_algorithm(self, seed: int) -> None:
        case = random_case(seed, "float32" if seed % 2 else "uint16", "chambolle")
        assert_equals_oracle(case, case.pipeline()(case.frame))

    @pytest.mark.slow
    def test_the_widest_simd_width(self) -> None:
        """At 4 lanes each family is compared with the usual width, which is compared above."""
        for seed in range(20):
            case = random_case(seed, "float32")
            assert_equals_oracle(case, case.pipeline(width=16)(case.frame))

    def test_comparison_is_not_empty(self) -> None:
        """Most random sub-apertures hold a spot that is compared."""
        valid: list[bool] = []
        for seed in range(10):
            case = random_case(seed, "uint16")
            valid.extend(case.pipeline()(case.frame).valid)
        assert np.mean(valid) > 0.5

    @given(seed=st.integers(0, 2**32 - 1))
    def test_steps_are_the_public_functions(self, seed: int) -> None:
        case = random_case(seed, "float32")
        stages = case.pipeline().explain(case.frame)
        n, pixels = len(case.layout), case.layout.pixels

        def each(name: str) -> Any:
            return case.settings.values(name, n, pixels)

        assert_same(stages.slopes, case.pipeline()(case.frame))
        assert np.array_equal(stages.raw, case.layout.images(case.frame), equal_nan=True)
        for s in range(n):
            denoised = stages.calibrated[s]
            if case.settings.estimator.without_denoising():
                denoised = fs.tv_denoise(
                    denoised,
                    each("noise_std")[s],
                    algorithm=case.settings.algorithm,
                    preset=case.settings.preset,
                    tolerance=each("tolerance")[s],
                    max_iterations=each("max_iterations")[s],
                    lower_strength=True,
                )
            assert np.array_equal(stages.denoised[s], denoised)
            background = fs.brightest_pixels(denoised, each("keep_brightest")[s], rule=str(each("rule")[s]))
            assert np.array_equal(stages.background_subtracted[s], background)
            if stages.slopes.valid[s]:
                zero = (case.layout.offsets[s] + case.reference[s]).astype(np.float32)
                position = fs.centre_of_gravity(background) - zero
                assert np.array_equal([stages.slopes.x[s], stages.slopes.y[s]], position)
                assert np.isclose(stages.slopes.flux[s], background.sum(), rtol=1e-5)


class TestFrames:
    def test_several_frames_equal_each_alone(self) -> None:
        case = random_case(1, "uint16")
        rng = np.random.default_rng(1)
        cube = rng.integers(0, 200, (70, *case.layout.frame_shape)).astype(np.uint16)
        together = case.pipeline()(cube)
        assert together.x.shape == together.valid.shape == (70, len(case.layout))
        assert together.vector.shape == (70, 2 * len(case.layout))
        for i, frame in enumerate(cube):
            alone = case.pipeline(threads=1)(frame)
            assert alone.x.shape == (len(case.layout),)
            for field in FIELDS:
                assert np.array_equal(getattr(together, field)[i], getattr(alone, field))
        assert_same(together, case.pipeline(threads=1)(cube))
        assert_same(together, case.pipeline(threads=7)(cube))

    def test_memory_layout_and_byte_order_do_not_matter(self) -> None:
        case = random_case(3, "uint16")
        pipeline = case.pipeline()
        expected = pipeline(case.frame)
        wide = np.zeros((120, 180), np.uint16)
        wide[::2, ::-3] = case.frame
        for frame in (
            wide[::2, ::-3],
            np.asfortranarray(case.frame),
            case.frame.astype(">u2"),
            case.frame.astype(">i4"),
            case.frame.astype(np.float64),
            case.frame.tolist(),
        ):
            # Another dtype saturates elsewhere.
            assert_same(pipeline(frame), expected, fields=("x", "y", "flux", "iterations", "bad_pixels"))

    def test_input_stays_as_it_is(self) -> None:
        case = random_case(4, "float32")
        copy = case.frame.copy()
        case.frame.flags.writeable = False
        case.pipeline().explain(case.frame)
        assert np.array_equal(case.frame, copy, equal_nan=True)

    def test_frames_of_another_sensor_are_refused(self) -> None:
        pipeline = random_case(5, "uint16").pipeline()
        for bad, words in (
            (np.zeros((60, 61)), "(60, 60) or (n, 60, 60), got (60, 61)"),
            (np.zeros((2, 2, 60, 60)), "(2, 2, 60, 60)"),
            (np.zeros(60), "2 dimensions"),
            (np.zeros((0, 60, 60)), "empty"),
            (np.zeros((60, 60), complex), "complex"),
            (np.full((60, 60), "x"), "real numbers"),
            ([[1], [1, 2]], "frame"),
        ):
            with refused("frame", words):
                pipeline(bad)
            with refused("frame"):
                pipeline.explain(bad)


class TestSettings:
    def test_changes_touch_only_their_subapertures(self) -> None:
        layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.7)
        n = len(layout)
        base = fs.Settings(noise_std=2.0, keep_brightest=10)
        frame = np.random.default_rng(6).poisson(9.0, layout.frame_shape).astype(np.float32)
        expected = fs.SlopePipeline(layout, base)(frame)
        where = [0, 5, n - 1]
        others = np.setdiff1d(np.arange(n), where)
        changes: list[dict[str, Any]] = [
            {"noise_std": 2.7},
            {"noise_std": 0.0},
            {"noise_std": 1e6},
            {"tolerance": 1e-6},
            {"max_iterations": 2},
            {"keep_brightest": 20},
            {"rule": "threshold"},
            {"flux_floor": 1.0, "keep_brightest": 1},
            {"noise_std": [1.0, 2.5, 3.5]},
        ]
        for change in changes:
            changed = fs.SlopePipeline(layout, base.replace(where=where, **change))(frame)
            assert_same(changed, expected, others)
            different = [
                not np.array_equal(getattr(changed, f)[where], getattr(expected, f)[where]) for f in FIELDS
            ]
            assert any(different), change
            mask = np.isin(np.arange(n), where)
            assert_same(changed, fs.SlopePipeline(layout, base.replace(where=mask, **change))(frame))
            single = [
                fs.SlopePipeline(
                    layout, base.replace(**{k: v[i] if isinstance(v, list) else v for k, v in change.items()})
                )(frame)
                for i in range(3)
            ]
            for i, s in enumerate(where):
                for field in FIELDS:
                    assert getattr(changed, field)[s] == getattr(single[i], field)[s]

    def test_no_tolerance_never_stops_early(self) -> None:
        """Whatever the tolerance of the sub-apertures that share its group."""
        layout = fs.Layout.grid((1, 4), pixels=4)
        frame = np.tile(np.array([0, 0, 9, 9], np.float32), (4, 4))  # float32 soon stops moving: change 0
        for tolerance in (0.0, [0.0, 0.1, 0.1, 0.1]):
            settings = fs.Settings(noise_std=2.25, tolerance=tolerance, max_iterations=500)
            slopes = fs.SlopePipeline(layout, settings)(frame)
            assert slopes.iterations[0] == 500
            assert not slopes.flags[0] & Flag.NOT_CONVERGED  # none was asked for

    def test_settings_for_another_sensor(self) -> None:
        layout = fs.Layout.grid((2, 2), pixels=4)
        with refused("noise_std", "4 values", "got 3"):
            fs.SlopePipeline(layout, fs.Settings(noise_std=[1, 2, 3]))
        with refused("noise_std", "sub-aperture 4 does not exist"):
            fs.SlopePipeline(layout, fs.Settings(noise_std=1).replace(where=4, noise_std=2.0))
        with refused("keep_brightest = 16", "at most 15", "subtract_next"):
            fs.SlopePipeline(layout, fs.Settings(noise_std=1, keep_brightest=16))
        fs.SlopePipeline(layout, fs.Settings(noise_std=1, keep_brightest=16, rule="threshold"))
        with refused("keep_brightest = 17", "at most 16"):
            fs.SlopePipeline(layout, fs.Settings(noise_std=1, keep_brightest=17, rule="subtract_kth"))

    def test_calibration_for_another_sensor(self) -> None:
        layout, settings = fs.Layout.grid((2, 2), pixels=4), fs.Settings(noise_std=1)
        with refused("calibration.dark", "(8, 8)", "(8, 9)"):
            fs.SlopePipeline(layout, settings, fs.Calibration(dark=np.zeros((8, 9))))
        with refused("calibration.bad_pixels", "(8, 0)"):
            fs.SlopePipeline(layout, settings, fs.Calibration(bad_pixels=[[0, 0], [8, 0]]))

    def test_pipeline_refuses_wrong_options(self) -> None:
        pipeline = partial(fs.SlopePipeline, fs.Layout.grid((2, 2), pixels=4), fs.Settings(noise_std=1))
        assert_each_refused(pipeline, width=[5], threads=[0, 1.5])

    def test_reference_has_three_equal_forms(self) -> None:
        case = random_case(7, "float32")
        frame = np.nan_to_num(case.frame, nan=20.0, posinf=20.0, neginf=20.0)

        def pipeline(reference: Any) -> fs.SlopePipeline:
            return fs.SlopePipeline(case.layout, case.settings, case.calibration, reference)

        expected = pipeline(case.reference)(frame)
        assert_same(pipeline(case.reference.T.ravel())(frame), expected)
        assert_same(pipeline(case.reference.tolist())(frame), expected)
        without = pipeline(None)(frame)
        assert_same(pipeline(np.zeros_like(case.reference))(frame), without)
        valid = without.valid
        assert np.allclose((without.x - expected.x)[valid], case.reference[valid, 0], atol=1e-6)
        assert np.allclose((without.y - expected.y)[valid], case.reference[valid, 1], atol=1e-6)
        zero = pipeline(without)(frame)
        assert np.allclose(zero.vector, 0.0, atol=1e-6)
        n = len(case.layout)
        for bad, words in (
            (np.zeros((n + 1, 2)), f"({n}, 2) or ({2 * n},)"),
            (np.zeros(n), f"({n}, 2)"),
            (np.full((n, 2), np.nan), "finite"),
            ("centre", "real numbers"),
            (pipeline(None)(np.stack([frame, frame])), f"({n}, 2)"),
        ):
            with refused("reference", words):
                pipeline(bad)

    def test_every_part_changes_the_fingerprint(self) -> None:
        layout, settings = fs.Layout.grid((2, 2), pixels=4), fs.Settings(noise_std=1)
        prints = {
            fs.SlopePipeline(layout, settings).fingerprint(),
            fs.SlopePipeline(layout, settings, reference=np.ones((4, 2))).fingerprint(),
            fs.SlopePipeline(layout, settings, fs.Calibration(dark=1.0)).fingerprint(),
            fs.SlopePipeline(layout, settings, fs.Calibration(saturation_adu=9.0)).fingerprint(),
            fs.SlopePipeline(layout, settings.replace(algorithm="chambolle")).fingerprint(),
            fs.SlopePipeline(layout, settings.replace(where=3, keep_brightest=3)).fingerprint(),
            fs.SlopePipeline(fs.Layout.grid((2, 2), pixels=4, origin=(1, 0)), settings).fingerprint(),
        }
        assert len(prints) == 7
        assert fs.SlopePipeline(layout, settings, threads=1).fingerprint() in prints


def test_slopes_at_the_search_range_are_flagged() -> None:
    layout = fs.Layout.grid((1, 3), pixels=12)
    frame = np.zeros(layout.frame_shape, np.float32)
    for column in (6, 12 + 9, 24 + 5):
        frame[6, column] = 100.0
    limited = fs.Settings(estimator="brightest", keep_brightest=1, rule="threshold", search_range_px=2.0)
    slopes = fs.SlopePipeline(layout, limited)(frame)
    assert slopes.x.tolist() == [0.5, 2.0, -0.5]
    assert ((slopes.flags & Flag.AT_SEARCH_LIMIT) != 0).tolist() == [False, True, False]
    assert slopes.measured.all()
    assert slopes.valid.tolist() == [True, False, True]
    assert replace(slopes, keep=Flag.AT_SEARCH_LIMIT).valid.all()


def test_integers_with_a_mask_saturate_as_without() -> None:
    layout = fs.Layout.grid((1, 2), pixels=8)
    frame = np.full(layout.frame_shape, 10, np.uint16)
    frame[3:5, 3:5] = frame[3:5, 11:13] = 60000
    frame[3, 3] = 65535
    mask = np.zeros(frame.shape, bool)
    mask[0, 0] = True
    pipeline = fs.SlopePipeline(layout, fs.Settings(estimator="brightest", keep_brightest=8))
    for item in (frame, np.ma.array(frame, mask=mask)):
        saturated = (pipeline(item).flags & int(fs.SubapertureFlag.SATURATED)) != 0
        assert saturated.tolist() == [True, False]
