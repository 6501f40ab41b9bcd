"""Training on recorded frames: splitting of the photons, errors against training with a truth."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import assert_each_refused, refused

from faintspot import Calibration, Layout
from faintspot.slopes.simulate import Detector, subapertures
from faintspot.slopes.spots.score import TrainedScore
from faintspot.slopes.training import train_estimator, train_from_frames
from faintspot.slopes.training.recorded import _Splitter

LAYOUT = Layout.stacked(20, (16, 16))


def as_frames(images: NDArray[Any]) -> NDArray[Any]:
    """Images (n, 20, 16, 16) as frames of `LAYOUT`."""
    return images.reshape(len(images), *LAYOUT.frame_shape)


def recorded(n: int = 4000, seed: int = 4, **options: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Images (n / 20, 20, 16, 16) and truth."""
    images, truth = subapertures(n, rng=np.random.default_rng(seed), **({"flux_e": 100.0} | options))
    return images.reshape(-1, 20, *images.shape[1:]), truth.reshape(-1, 20, 2)


def rms(score: TrainedScore, images: NDArray[Any], truth: NDArray[Any]) -> float:
    """Rms error, gain corrected."""
    found = score.apply(images, images.sum(axis=(2, 3)).mean(axis=1)[:, None])
    found /= np.sum(found * truth) / np.sum(truth**2)
    return float(np.sqrt(np.mean((found - truth) ** 2)))


@pytest.mark.parametrize(
    ("read_noise", "loss"),
    [(0.1, 1.08), (1.0, 1.25)],  # measured: 1.04, 1.13
)
def test_nearly_as_good_as_with_a_truth(read_noise: float, loss: float) -> None:
    detector = Detector(read_noise_e=read_noise)
    images, _ = recorded(detector=detector)
    score = train_from_frames(
        as_frames(images),
        LAYOUT,
        Calibration(read_noise_e=read_noise),
        draws=3,
        target_radius_px=5.0,
        rng=np.random.default_rng(1),
    )
    with_truth = train_estimator(
        flux_e=100.0, detector=detector, realisations=6000, rng=np.random.default_rng(1)
    )
    fresh = recorded(seed=5, detector=detector)
    assert rms(score, *fresh) < loss * rms(with_truth, *fresh)
    np.testing.assert_allclose(score.flux_e, 100.0, rtol=0.02)
    assert np.all(score.standard_error_px > 0.8 * rms(with_truth, *fresh))


@pytest.mark.parametrize(("read_noise", "em_gain"), [(0.3, 1.0), (2.0, 1.0), (20.0, 100.0)])
def test_parts_do_not_covary_but_for_what_is_known(read_noise: float, em_gain: float) -> None:
    # One image many times: the target's covariance with a pixel of the features' part is the sum of the known
    # covariance images, to the error of a covariance from n draws.
    detector = Detector(read_noise_e=read_noise, em_gain=em_gain)
    n = 40_000
    images, _ = subapertures(
        n,
        shape=(4, 4),
        flux_e=12.0,
        positions=np.zeros((n, 2)),
        detector=detector,
        rng=np.random.default_rng(1),
    )
    calibration = Calibration(read_noise_e=read_noise, em_gain=em_gain)
    splitter = _Splitter(
        0.7, (read_noise / em_gain) ** 2, calibration.excess_noise, 1.0, "reference", 2.0, np.inf
    )
    flux = np.full(n, 12.0)
    sample, noise = splitter.sample(
        images.astype(float), flux, flux, np.zeros((n, 2)), np.random.default_rng(2)
    )
    assert sample.covariance is not None
    target, features = sample.truth[:, 0], sample.images.reshape(n, -1)
    found = (target - target.mean()) @ (features - features.mean(axis=0)) / n
    error = np.std(target) * np.std(features, axis=0) / np.sqrt(n)
    np.testing.assert_array_less(
        abs(found - sample.covariance[:, 0].mean(axis=0).ravel()), 4.5 * error + 1e-12
    )
    # The flux of both parts is the images', and the target's noise is known.
    np.testing.assert_allclose(
        features.mean(axis=0), images.mean(axis=0).ravel() / 12, atol=5 * error.max() + 0.005
    )
    assert noise[:, 0].mean() == pytest.approx(np.var(target), rel=0.05)


def test_frames_are_calibrated() -> None:
    images, _ = recorded(2000)
    layout = Layout.grid((4, 5), pixels=16)
    frames = np.zeros((len(images), *layout.frame_shape), np.float32)
    for number, (row, column) in enumerate(layout.corners):
        frames[:, row : row + 16, column : column + 16] = images[:, number] / 2 + 100
    raw = Calibration(dark=100.0, gain_e_per_adu=2.0, read_noise_e=0.1)
    from_adu = train_from_frames(frames, layout, raw, draws=1, rng=np.random.default_rng(1))
    from_electrons = train_from_frames(
        as_frames(images), LAYOUT, Calibration(read_noise_e=0.1), draws=1, rng=np.random.default_rng(1)
    )
    # Subtracting 100 ADU in float32 leaves 1e-5 e- of round-off, which the regression amplifies a little.
    np.testing.assert_allclose(from_adu.tables, from_electrons.tables, atol=2e-3)


def test_classes_and_kinds() -> None:
    images, _ = recorded(4000, flux_e=np.repeat([30.0, 300.0], 2000))
    done: list[tuple[int, int]] = []
    score = train_from_frames(
        as_frames(images),
        LAYOUT,
        Calibration(read_noise_e=0.1),
        index=[0] * 10 + [1] * 10,
        symmetry="aligned",
        draws=1,
        passes=2,
        start="peak",
        rng=np.random.default_rng(1),
        progress=lambda *at: done.append(at),
    )
    np.testing.assert_allclose(score.flux_e, [30.0, 300.0], rtol=0.03)
    assert score.tables.shape[:4] == (2, 2, 2, 2)
    assert score.start == "peak"
    assert done == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_bad_options() -> None:
    frames = np.random.default_rng(1).poisson(1.0, (20, *LAYOUT.frame_shape)).astype(float)
    good = partial(train_from_frames, frames=frames, layout=LAYOUT, calibration=Calibration(read_noise_e=0.1))
    assert_each_refused(
        good,
        frames=[frames[0], np.full((5, 320, 16), np.nan), np.zeros((20, 320, 16))],
        calibration=[Calibration()],
        reference=[np.zeros((3, 2))],
        index=[[0, 2] * 10],
        symmetry=["none"],
        start=["middle"],
        fraction=[1.0],
        draws=[0],
        passes=[9],
        node_spacing_px=[0.0],
        target_radius_px=[0.0],
    )
    for wrong, message in (
        (np.ones((5, 16, 16)), "expected"),
        (frames[:4], "at least 100 images of each kind"),
    ):
        with refused(message):
            good(frames=wrong)
