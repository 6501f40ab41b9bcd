"""Scintillation and fades of light whose index, speed and fades are known, behind photon and read noise."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal, special, stats
from tests.refusals import assert_each_refused

from faintspot.loop.telemetry.scintillation import measure_scintillation

RATE_HZ = 500.0
SUBAPERTURE, APERTURE, HALF, SHARE, LENGTH = range(5)


def normal(rng: np.random.Generator, frames: int, correlation: float, is_smooth: bool) -> NDArray[np.float64]:
    """Return a normal process, whose correlation is a Gaussian or exponential function of time."""
    if not is_smooth:
        step = math.exp(-1 / correlation)
        noise = rng.standard_normal(frames) * math.sqrt(1 - step**2)
        noise[0] /= math.sqrt(1 - step**2)
        return np.asarray(signal.lfilter([1], [1, -step], noise))
    places = np.arange(-int(4 * correlation), int(4 * correlation) + 1)
    kernel = np.exp(-((places / correlation) ** 2))
    longer = rng.standard_normal(frames + len(kernel) - 1)
    return np.asarray(signal.fftconvolve(longer, kernel / np.linalg.norm(kernel), mode="valid"))


def log_normal(rng: np.random.Generator, index: float, frames: int, **kind: Any) -> NDArray[np.float64]:
    log_variance = math.log1p(index)
    return np.exp(math.sqrt(log_variance) * normal(rng, frames, **kind) - log_variance / 2)


def gamma_gamma(rng: np.random.Generator, index: float, frames: int, **kind: Any) -> NDArray[np.float64]:
    """Return the product of a slow and a fast gamma variable: Al-Habash et al. 2001."""
    order = 1 / (math.sqrt(1 + index) - 1)
    slow = normal(rng, frames, **(kind | {"correlation": 3 * kind["correlation"]}))
    parts = (
        stats.gamma.ppf(special.ndtr(each), order) / order for each in (normal(rng, frames, **kind), slow)
    )
    return np.asarray(math.prod(parts))


def measured(
    rng: np.random.Generator, light: NDArray[np.float64], flux_e: float, n: int
) -> NDArray[np.float64]:
    """Return the fluxes of n sub-apertures with read noise of 2 e-."""
    return rng.poisson(flux_e * light[:, None], (len(light), n)) + rng.normal(0, 2.0, (len(light), n))


def test_index_speed_and_fades_of_bright_light() -> None:
    """Within three errors of the truth, that of the fades by the bivariate normal law."""
    rng, index, correlation = np.random.default_rng(1), 0.3, 4.0
    light = log_normal(rng, index, 10_000, correlation=correlation, is_smooth=True)
    found = measure_scintillation(measured(rng, light, 1000.0, 30), RATE_HZ)
    spread = math.sqrt(math.log1p(index))
    limit = math.log(0.5) / spread + spread / 2
    share = float(special.ndtr(limit))
    one_frame = math.exp(-1 / (2 * correlation**2))
    both = stats.multivariate_normal.cdf([limit, limit], cov=[[1, one_frame], [one_frame, 1]])
    truth = {SUBAPERTURE: index, APERTURE: index, SHARE: share, LENGTH: share / (share - both) / RATE_HZ}
    for number, expected in truth.items():
        value = found.values[number]
        assert abs(value.value - expected) < 3 * value.error < 0.5 * expected, value
    covariance = np.expm1(spread**2 * np.exp(-(np.arange(200) ** 2) / (2 * correlation**2)))
    frequency, power = np.fft.rfftfreq(400, 1 / RATE_HZ), np.fft.hfft(np.append(covariance, 0.0), 400)[:201]
    half = np.interp(0.5, np.cumsum(power) / power.sum(), frequency)
    assert found.values[HALF].value == pytest.approx(half, rel=0.1)
    np.testing.assert_allclose(found.index, index, atol=5 * found.index_error.max())


def test_fades_that_noise_makes_are_taken_off() -> None:
    """A tenth of them; of the same light without noise the share is known."""
    rng = np.random.default_rng(0)
    light = log_normal(rng, 0.1, 20_000, correlation=4.0, is_smooth=True)
    true = measure_scintillation(light[:, None] * np.ones(10), RATE_HZ).values[SHARE].value
    flux = measured(rng, light, 60.0, 10)
    made = np.mean(flux.sum(axis=1) < 0.5 * flux.sum(axis=1).mean()) - true
    assert made > 0.1 * true
    assert abs(measure_scintillation(flux, RATE_HZ).values[SHARE].value - true) < 0.5 * made


def test_light_that_is_steady_is_not_seen_to_vary() -> None:
    """Faint light, too, whose noise varies 30 times as much as the limit that is stated."""
    for flux_e, seed in ((5.0, 2), (500.0, 3)):
        rng = np.random.default_rng(seed)
        found = measure_scintillation(measured(rng, np.ones(4000), flux_e, 20), RATE_HZ)
        assert not any(math.isfinite(value.value) for value in found.values)
        limit = float(found.values[APERTURE].remark.split()[3])
        assert 0 < limit < 1 / flux_e
        assert (np.abs(found.index) < 5 * found.index_error).all()


def test_light_without_noise_that_never_or_hardly_varies() -> None:
    assert not any(
        math.isfinite(each.value) for each in measure_scintillation(np.ones((800, 3)), 500.0).values
    )
    slow = 2 + np.sin(np.arange(800) / 400)[:, None] * np.ones(3)
    assert not math.isfinite(measure_scintillation(slow, RATE_HZ).values[HALF].value)


def test_lost_frames_and_dim_sub_apertures_do_no_harm() -> None:
    rng = np.random.default_rng(4)
    light = log_normal(rng, 0.2, 8000, correlation=5.0, is_smooth=True)
    flux, frame = measured(rng, light, 100.0, 10), np.arange(8000)
    flux[:, 3] = rng.normal(0, 2.0, 8000)
    flux[5, 4] = np.nan
    kept = rng.random(8000) > 0.02
    found = measure_scintillation(flux[kept], RATE_HZ, frame=frame[kept])
    assert np.flatnonzero(np.isnan(found.index)).tolist() == [3, 4]
    for number in (SUBAPERTURE, APERTURE):
        assert abs(found.values[number].value - 0.2) < 3 * found.values[number].error
    assert not math.isfinite(found.values[HALF].value)  # hardly a piece is whole


def test_what_is_refused() -> None:
    flux = [np.ones((399, 3)), np.ones(1000), np.zeros((1000, 3)), np.full((1000, 3), np.nan)]
    known: dict[str, Any] = {"flux": np.ones((1000, 3)), "frame_rate_hz": RATE_HZ}
    assert_each_refused(
        lambda **wrong: measure_scintillation(**known | wrong),
        flux=flux,
        level=[0.0, 1.5],
        frame_rate_hz=[0.0],
        frame=[np.zeros(1000, int)],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "is_smooth", "index", "flux_e"),
    [
        (log_normal, True, 0.02, 5.0),
        (log_normal, False, 0.3, 500.0),
        (gamma_gamma, True, 0.3, 5.0),
        (gamma_gamma, False, 0.02, 500.0),
    ],
)
def test_intervals_of_the_index_hold(law: Any, is_smooth: bool, index: float, flux_e: float) -> None:
    """At least 34 of 40: fewer of them, if 95 % hold, once in 300 times."""
    held = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, int(flux_e)])
        light = law(rng, index, 10_000, correlation=5.0, is_smooth=is_smooth)
        value = measure_scintillation(measured(rng, light, flux_e, 8), RATE_HZ).values[SUBAPERTURE]
        low, high = value.interval if math.isfinite(value.value) else (0.0, float(value.remark.split()[3]))
        held += low <= index <= high
    assert held >= 34
