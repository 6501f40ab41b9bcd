"""Detector: mean and variance against its own prediction, and each source on its own.

Statistical tests are two-sided at 4.9 standard errors, a false-alarm rate of 1e-6 for sums that are nearly
Gaussian (they are: 2,000 pixels or more). Seeds are fixed, so a test passes for good or fails for good.
"""

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

from faintspot.base.errors import InputError
from faintspot.slopes.simulate import Detector

STANDARD_ERRORS = 4.9  # Gaussian, two-sided: 1e-6
SHAPE = (400, 500)


def check_mean_and_variance(detector: Detector, level: float) -> None:
    mean_e = np.full(SHAPE, level)
    electrons = detector.to_electrons(detector.expose(mean_e, np.random.default_rng(1))).astype(np.float64)
    expected = level + float(np.mean(detector.dark_e)) + float(np.mean(detector.background_e))
    variance = float(np.mean(detector.variance(mean_e)))
    n = electrons.size
    # float32 output: half a unit in the last place, 6e-8 of the value.
    round_off = 1e-7 * (1 + expected + abs(detector.offset_adu) * detector.gain_e_per_adu / detector.em_gain)
    assert abs(electrons.mean() - expected) <= STANDARD_ERRORS * np.sqrt(variance / n) + round_off
    deviations = np.square(electrons - expected)
    standard_error = deviations.std() / np.sqrt(n)  # holds for any distribution
    assert abs(deviations.mean() - variance) <= STANDARD_ERRORS * standard_error + round_off


@pytest.mark.parametrize("read_noise_e", [0.0, 0.1, 3.0])
@pytest.mark.parametrize("em_gain", [1.0, 500.0])
@pytest.mark.parametrize("level", [0.0, 0.2, 25.0])
def test_mean_and_variance(read_noise_e: float, em_gain: float, level: float) -> None:
    """Compare 200,000 pixels with the mean and the variance that the detector states."""
    check_mean_and_variance(Detector(read_noise_e, em_gain=em_gain, dark_e=0.3, background_e=0.4), level)
    if read_noise_e == 3.0:  # at least 0.6 ADU, where the rounding error is uniform to 1e-3 of itself
        for gain in (0.7, 5.0):
            quantised = Detector(3.0, em_gain=em_gain, gain_e_per_adu=gain, offset_adu=100, bits=20)
            check_mean_and_variance(quantised, level + 1.0)


def test_register_output_of_one_electron_is_exponential() -> None:
    # Full well of one electron: every exposed pixel sends exactly one, Gamma(1, g), mean and std g.
    detector = Detector(0.0, em_gain=300.0, full_well_e=1.0)
    out = detector.expose(np.full(SHAPE, 50.0), np.random.default_rng(4)).astype(np.float64)
    n = out.size
    assert abs(out.mean() - 300) <= STANDARD_ERRORS * 300 / np.sqrt(n)
    share = np.mean(out > 300)
    expected = np.exp(-1)
    assert abs(share - expected) <= STANDARD_ERRORS * np.sqrt(expected * (1 - expected) / n)
    assert detector.expose(np.zeros((3, 3)), np.random.default_rng(4)).max() == 0


@pytest.mark.parametrize(
    ("bits", "dtype"), [(8, np.uint16), (16, np.uint16), (17, np.uint32), (32, np.uint32)]
)
def test_quantised_output_saturates(bits: int, dtype: type) -> None:
    detector = Detector(2.0, gain_e_per_adu=1e-3, offset_adu=0.0, bits=bits)
    bright = detector.expose(np.full((4, 4), 1e9), np.random.default_rng(0))
    assert bright.dtype == dtype
    assert np.all(bright == 2**bits - 1)
    dark = detector.expose(np.zeros((50, 50)), np.random.default_rng(0))
    assert dark.min() == 0  # negative read noise is cut off, not wrapped around


def test_full_well_limits_the_electrons() -> None:
    detector = Detector(0.0, full_well_e=100.0, background_e=40.0)
    assert np.all(detector.expose(np.full((5, 5), 500.0), np.random.default_rng(0)) == 100)


def test_electrons_follow_from_gain_offset_and_em_gain() -> None:
    detector = Detector(0.0, gain_e_per_adu=2.5, offset_adu=300.0)
    adu = detector.expose(np.full((30, 30), 8.0), np.random.default_rng(5))
    plain = Detector(0.0).expose(np.full((30, 30), 8.0), np.random.default_rng(5))
    # float32 ADU near 300: 3e-5 ADU.
    np.testing.assert_allclose(adu, 300 + plain / 2.5, atol=5e-5)
    np.testing.assert_allclose(detector.to_electrons(adu), plain, atol=2e-4)
    assert adu.dtype == np.float32
    assert detector.to_electrons(adu).dtype == np.float32
    assert detector.to_electrons(np.zeros(3)).dtype == np.float64
    amplified = Detector(0.0, em_gain=20.0, gain_e_per_adu=4.0, offset_adu=1.0)
    assert amplified.to_electrons(np.array([6.0])) == pytest.approx(1.0)


def test_hot_pixels_and_maps() -> None:
    dark_e = np.zeros((6, 8))
    dark_e[1, 2] = 400.0
    read_noise_e = np.zeros((6, 8))
    read_noise_e[0, 0] = 5.0
    detector = Detector(read_noise_e, dark_e=dark_e, hot_pixels=[(5, 7, 1000.0), (1, 2, 500)])
    out = detector.expose(np.zeros((2000, 6, 8)), np.random.default_rng(2)).astype(np.float64)
    mean = out.mean(axis=0)
    for (row, column), level in {(5, 7): 1000.0, (1, 2): 900.0}.items():
        assert abs(mean[row, column] - level) <= STANDARD_ERRORS * np.sqrt(level / 2000)
    others = np.ones((6, 8), dtype=bool)
    others[[5, 1, 0], [7, 2, 0]] = False
    assert np.all(out[:, others] == 0)
    assert out[:, 0, 0].std() == pytest.approx(5.0, rel=STANDARD_ERRORS / np.sqrt(2 * 2000))
    variance = detector.variance(np.zeros((6, 8)))
    assert (variance[5, 7], variance[1, 2], variance[0, 0], variance[3, 3]) == (1000.0, 900.0, 25.0, 0.0)


def test_same_seed_same_frames() -> None:
    detector = Detector(1.0, em_gain=100.0, dark_e=0.2, background_e=1.0)
    mean_e = np.full((3, 16, 16), 2.0)
    first = detector.expose(mean_e, np.random.default_rng(9))
    np.testing.assert_array_equal(first, detector.expose(mean_e, np.random.default_rng(9)))
    assert not np.array_equal(first, detector.expose(mean_e, np.random.default_rng(10)))
    rng = np.random.default_rng(9)
    assert not np.array_equal(detector.expose(mean_e, rng), detector.expose(mean_e, rng))
    assert not np.array_equal(detector.expose(mean_e), detector.expose(mean_e))


def test_sources_draw_independently_of_each_other() -> None:
    mean_e = np.full((32, 32), 4.0)

    def expose(read_noise_e: float = 0.0, level: Any = mean_e, **options: Any) -> Any:
        frame = Detector(read_noise_e, **options).expose(level, np.random.default_rng(6))
        return frame.astype(np.float64)

    photons = expose()
    # Whole electrons are exact; the read noise comes back to float32 round-off.
    np.testing.assert_array_equal(
        expose(dark_e=2.0) - photons, expose(dark_e=2.0, background_e=3.0) - expose(background_e=3.0)
    )
    np.testing.assert_allclose(expose(1.5) - photons, expose(1.5, dark_e=2.0) - expose(dark_e=2.0), atol=1e-5)
    np.testing.assert_allclose(expose(3.0) - photons, 2 * (expose(1.5) - photons), atol=1e-5)
    np.testing.assert_allclose(expose(1.5) - photons, expose(1.5, level=np.zeros((32, 32))), atol=1e-5)
    np.testing.assert_array_equal(expose(dark_e=2.0) - photons, expose(dark_e=2.0, level=np.zeros((32, 32))))
    # The register's draws depend on its input, so only the read noise after it can be compared: outputs
    # are of the order of 1e3 electrons, float32.
    np.testing.assert_allclose(
        expose(1.5, em_gain=100.0) - expose(em_gain=100.0), expose(1.5) - photons, atol=1e-3
    )


def test_inputs_stay_as_they_were_and_the_detector_is_immutable() -> None:
    dark_e, mean_e = np.ones((4, 4)), np.full((4, 4), 3.0)
    detector = Detector(dark_e=dark_e, hot_pixels=[(0, 0, 9.0)])
    detector.expose(mean_e, np.random.default_rng(0))
    detector.variance(mean_e)
    assert np.all(dark_e == 1)
    assert np.all(mean_e == 3)
    dark_e[:] = 7  # the detector has its own copy
    assert np.all(detector.dark_e == 1)
    with pytest.raises(ValueError, match="read-only"):
        detector.dark_e[0, 0] = 2  # type: ignore[index]
    with pytest.raises(FrozenInstanceError):
        detector.em_gain = 3.0  # type: ignore[misc]


def test_bad_detectors_are_named_in_one_line() -> None:
    assert_each_refused(
        Detector,
        read_noise_e=[-0.1, np.nan, [1.0, 2.0]],
        dark_e=[-1],
        background_e=[[[1.0, -1.0]]],
        relative_gain=[0.0],
        blinking_pixels=[[(1, 2)]],
        hot_pixels=[[(1, 2)], 0.1, [(-1, 2, 3.0)], [(1.5, 2, 3.0)], [(1, 2, -3.0)]],
    )


@pytest.mark.parametrize(
    ("options", "mean_e"),
    [
        ({}, [[-1.0]]),
        ({}, [[np.nan]]),
        ({}, [[1e13]]),
        ({}, [1.0, 2.0]),
        ({}, "light"),
        ({"dark_e": np.zeros((3, 4))}, np.zeros((4, 3))),
        ({"read_noise_e": np.zeros((1, 1))}, np.zeros((4, 3))),
        ({"hot_pixels": [(4, 0, 1.0)]}, np.zeros((4, 3))),
    ],
)
def test_bad_flux_is_refused_in_one_line(options: dict[str, Any], mean_e: Any) -> None:
    for method in (Detector(**options).expose, Detector(**options).variance):
        with refused("mean_e"):
            method(mean_e)


def test_a_generator_that_cannot_spawn_is_refused() -> None:
    class Entropy(np.random.bit_generator.ISeedSequence):
        def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
            return np.ones(n_words, dtype=dtype)

    rng = np.random.Generator(np.random.PCG64(Entropy()))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="spawn"):
        Detector().expose(np.zeros((2, 2)), rng)


class TestCMOS:
    def test_distribution_of_the_noise(self) -> None:
        """Of 10,000 log-normal values: the median to 0.9 %, the root mean square to 1 %; four of these."""
        noise = np.asarray(
            Detector.cmos((100, 100), 0.3, spread=0.7, rng=np.random.default_rng(1)).read_noise_e
        )
        assert np.median(noise) == pytest.approx(0.3, rel=0.04)
        assert np.sqrt(np.mean(noise**2)) == pytest.approx(0.3 * np.exp(0.49), rel=0.05)

    def test_blinking_pixels_have_two_levels(self) -> None:
        detector = Detector(0.0, blinking_pixels=[(1, 2, 8.0)], offset_adu=50.0)
        out = detector.expose(np.zeros((4000, 3, 4)), np.random.default_rng(3)).astype(np.float64)
        assert set(out[:, 1, 2]) == {46.0, 54.0}
        assert abs(out[:, 1, 2].mean() - 50.0) < STANDARD_ERRORS * 4 / np.sqrt(4000)
        assert np.all(np.delete(out.reshape(4000, 12), 6, axis=1) == 50)
        assert detector.variance(np.zeros((3, 4)))[1, 2] == 16.0

    def test_relative_gain_is_the_flat(self) -> None:
        gain = np.array([[1.0, 1.2], [0.9, 1.1]])
        detector = Detector(0.0, relative_gain=gain, gain_e_per_adu=2.0, offset_adu=10.0)
        adu = detector.expose(np.full((2, 2), 1e6), np.random.default_rng(5))
        ideal = Detector(0.0, gain_e_per_adu=2.0).expose(np.full((2, 2), 1e6), np.random.default_rng(5))
        np.testing.assert_allclose(adu - 10.0, ideal * gain, rtol=1e-6)
        np.testing.assert_allclose(detector.to_electrons(adu), 2.0 * ideal, rtol=1e-6)
