"""A loop on a laser guide star: images, low orders of a natural star, a profile that is followed."""

from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.results import default_methods, tuned_values, with_choice
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop, simulate_loop
from faintspot.loop.simulation.engine_files import write_engine_files
from faintspot.loop.simulation.laser import (
    FollowedSodium,
    LaserSource,
    LowOrders,
    laser_guide_star,
    learn_sodium,
)
from faintspot.loop.simulation.telescope import prepare
from faintspot.slopes.spots.sodium import SodiumProfile

pytest.importorskip("hcipy")

BEFORE, AFTER = (0.0, 0.0, 1.0, 0.0, 0.0), (0.0, 0.466, 0.0, 0.534, 0.0)  # of the same mean altitude
ALTITUDES = (80e3, 86e3, 90e3, 96e3, 100e3)


def loop() -> LoopConfiguration:
    """7 x 7 sub-apertures of 0.6 m, windows of 8 px of 0.4 arcsec, launched from the side."""
    sensor = {"pixels": 8, "wavelength_m": 589e-9, "pixel_scale_arcsec": 0.4, "samples": 16}
    laser = {"launch_m": (-6.0, 0.0), "altitude_m": ALTITUDES, "density": (BEFORE,), "jitter_arcsec": 0.1}
    return (
        LoopConfiguration()
        .replace("laser", **laser)
        .replace("sensor", **sensor)
        .replace("run", frames=60, settle_frames=20)
        .replace("control", frame_rate_hz=500.0, gain=0.4)
        .replace("camera", photons_per_subaperture=500.0, read_noise_e=0.5)
        .replace("natural_star", photons=1e5)
    )


LOOP = loop()


@pytest.fixture(scope="module")
def source() -> LaserSource:
    changing = LOOP.replace("laser", time_s=(0.0, 1.0), density=(BEFORE, AFTER))
    return LaserSource(changing, prepare(LOOP).sensor)


def test_images_are_those_of_the_layer(source: LaserSource) -> None:
    """Flux in the window and centre of gravity of lit sub-apertures; a point's wings take 4 % and 0.02 px."""
    sensor = source.sensor(0)
    flat = np.zeros((sensor.points,) * 2, np.float32)
    images, lit = sensor.spots(flat), sensor.illumination > 0.999
    assert LOOP.laser is not None
    star = laser_guide_star(LOOP, sensor.layout.cells, LOOP.laser.spot_fwhm_arcsec)
    expected = star.images(LOOP.laser.profiles()[0], (8, 8))
    place = np.arange(8) - 3.5
    for weight in (place, place[:, None]):
        found, wanted = (
            (weight * each).sum(axis=(1, 2)) / each.sum(axis=(1, 2)) for each in (images, expected)
        )
        np.testing.assert_allclose(found[lit], wanted[lit], atol=0.02)
    np.testing.assert_allclose(images[lit].sum(axis=(1, 2)), expected[lit].sum(axis=(1, 2)), rtol=0.04)


def test_between_two_times_images_are_interpolated(source: LaserSource) -> None:
    flat = np.zeros((source.sensor(0).points,) * 2, np.float32)
    first, middle, last, later = (source.sensor(frame).spots(flat) for frame in (0, 250, 500, 900))
    np.testing.assert_allclose(middle, 0.5 * (first + last), atol=1e-4 * first.max())
    np.testing.assert_array_equal(last, later)
    assert np.abs(last - first).max() > 0.1 * first.max()


def test_the_beam_moves_all_spots() -> None:
    """By 0.1 arcsec rms of pixels of 0.4 arcsec; of 400 frames, which know it to 3.5 %."""
    source, sensor = LaserSource(LOOP, prepare(LOOP).sensor), prepare(LOOP).sensor
    flat = np.zeros((sensor.points,) * 2, np.float32)
    moved = [
        sensor.mean_slopes_px(source.jittered(flat, (1, 0, frame))).reshape(2, -1) for frame in range(400)
    ]
    np.testing.assert_allclose(np.std(moved, axis=2), 0.0, atol=1e-4)
    np.testing.assert_allclose(np.std(np.mean(moved, axis=2), axis=0), 0.25, rtol=0.11)


def test_a_natural_star_gives_tip_tilt_and_slow_focus() -> None:
    """A bright one: tilt of the wavefront, not of the beam; focus of a displaced layer within 25 frames."""
    optics = prepare(LOOP)
    bright = LOOP.replace("natural_star", photons=1e12, focus_frames=5, focus_gain=1.0)
    orders = LowOrders(bright, optics.sensor, 1, 0)
    n, flags = len(optics.sensor.layout), np.zeros(len(optics.sensor.layout), np.uint8)
    flat = np.zeros((optics.sensor.points,) * 2, np.float32)
    tilt = 30.0 * np.broadcast_to(np.linspace(-1, 1, len(flat), dtype=np.float32), flat.shape)
    true = optics.sensor.mean_slopes_px(tilt)
    seen = orders.merged(0, tilt, true + 0.3, flags)
    np.testing.assert_allclose(seen.reshape(2, n).mean(axis=1), true.reshape(2, n).mean(axis=1), atol=1e-3)
    # The layer is out of focus: the loop makes the laser's slopes 0, so that the wavefront has the opposite.
    line = np.linspace(-1, 1, len(flat), dtype=np.float32)
    curved = 20.0 * (line**2 + line[:, None] ** 2)
    true = optics.sensor.mean_slopes_px(curved)
    orders = LowOrders(bright, optics.sensor, 1, 0)
    for frame in range(5, 10):
        left = orders.merged(frame, curved, np.zeros(2 * n), flags)
    assert np.corrcoef(left, true)[0, 1] > 0.999
    assert np.linalg.norm(left) == pytest.approx(np.linalg.norm(true), rel=0.05)


ML = fs.Settings("ml", search_range_px=2.0)
METHODS = [
    Method("window", fs.Settings("window")),
    Method("filter", fs.Settings("window"), variants=("filter",)),
    Method("ml, followed", ML, variants=("followed",)),
]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.label)
def test_every_method_closes_the_loop(method: Method) -> None:
    record = simulate_loop(LOOP, [method])
    assert record.mean_strehl() > 0.6  # without correction: 0.1
    assert record.zernike_nm.shape == (60, 10)


def test_the_followed_profile_is_that_of_later_frames(source: LaserSource) -> None:
    """Width of the layer after a change, without noise: within 10 %; before, half of it."""
    sensor, later = source.sensor(0), source.sensor(900)
    flat = np.zeros((sensor.points,) * 2, np.float32)
    known = learn_sodium(LOOP, sensor.layout, sensor.spots(flat)[None], 1)
    quick = LOOP.replace("laser", follow_every_frames=20, follow_time_constant_frames=1.0)
    followed = FollowedSodium(quick, sensor.layout, known)
    frame = later.frame(later.spots(flat)) * LOOP.photons
    new = [followed.take(frame, np.zeros(2 * len(sensor.layout))) for _ in range(20)]
    assert np.flatnonzero(new).tolist() == [19]
    assert LOOP.laser is not None
    before, after = SodiumProfile(ALTITUDES, BEFORE), SodiumProfile(ALTITUDES, AFTER)
    assert known.fit.profile.std_m == pytest.approx(before.std_m, rel=0.1)
    assert followed.sodium.fit.profile.std_m == pytest.approx(after.std_m, rel=0.1)
    assert after.std_m > 1.9 * before.std_m


def test_methods_by_name() -> None:
    for name in default_methods(LOOP):
        assert Method.named(name).name == name
    kind = Method.named("window+filter+followed")
    choice = {name: each.first[0] for name, each in tuned_values(kind, LOOP).items()}
    method = with_choice(kind, LOOP, choice)
    assert method.variants == ("filter", "followed")
    with pytest.raises(InputError, match="expected a configuration with a laser"):
        with_choice(kind, LoopConfiguration(), choice)
    with pytest.raises(InputError, match="expected estimator 'window'"):
        Method.named("ml+filter")


def test_text_and_shipped_configuration() -> None:
    assert LoopConfiguration.from_text(LOOP.to_text()) == LOOP
    assert "laser" not in LoopConfiguration().to_text()
    assert load_loop("lgs_eight_metre").laser is not None


@pytest.mark.parametrize(
    ("section", "values"),
    [
        ("laser", {"launch_m": (1.0,)}),
        ("laser", {"density": ((1.0, 2.0),)}),
        ("laser", {"density": 3.0}),
        ("laser", {"density": ((0.0, -1.0, 1.0, 0.0, 0.0),)}),
        ("laser", {"density": ((0.0,) * 5,)}),
        ("laser", {"altitude_m": ALTITUDES[::-1]}),
        ("laser", {"time_s": (1.0, 0.0), "density": (BEFORE, AFTER)}),
        ("laser", {"site_altitude_m": 9e3, "altitude_m": (9.5e3, *ALTITUDES[1:])}),
        ("laser", {"zenith_distance_deg": 80.0}),
        ("natural_star", {"photons": 0.0}),
        ("sensor", {"spot_elongation": 2.0}),
        ("sensor", {"samples": 8}),
    ],
)
def test_what_is_refused(section: str, values: dict[str, Any]) -> None:
    with refused():
        LOOP.replace(section, **values)


def test_what_does_not_go_together(tmp_path: Any) -> None:
    with pytest.raises(InputError, match="natural_star"):
        LoopConfiguration().replace("natural_star", photons=10.0)
    with pytest.raises(InputError, match="laser"):
        write_engine_files(LOOP, tmp_path)
