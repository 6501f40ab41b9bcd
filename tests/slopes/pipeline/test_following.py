"""Spots that leave their windows keep their identity, and those that do not are flagged."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.frames.following import Case, Recording, recording
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.sensor.binning import magnified_layout

# Most valid slopes of wrong spots; random recordings of the benchmark have fewer.
MOST_WRONG = 0.01
FLAG = fs.SubapertureFlag


def followed(record: Recording) -> fs.Slopes:
    return fs.SpotFollower(record.pipeline())(record.frames)


def share_of_wrong(record: Recording, slopes: fs.Slopes) -> float:
    return float(np.mean(record.is_wrong(slopes)[slopes.valid]))


@pytest.mark.parametrize(
    "case",
    mostly_slow(
        1,
        [
            Case(frames=20),
            Case(frames=20, geometry="hexagonal"),
            Case(frames=20, across=6, flux_e=300.0),
            Case(frames=20, jitter=0.15),
            Case(frames=20, missing=0.2),
            Case(only_last=True, order=3),
        ],
    ),
    ids=lambda case: (
        f"{case.geometry}-{case.across}-{case.flux_e:g}-{case.jitter}-{case.missing}-{case.order}"
    ),
)
def test_identity_of_spots_moved_by_up_to_one_and_a_half_pitches(case: Case) -> None:
    record = recording(2001, case)
    slopes = followed(record)
    assert share_of_wrong(record, slopes) <= MOST_WRONG
    # Crossing spots and those at the edge of strong aberrations are flagged.
    assert np.mean(slopes.valid[:, record.has_spot]) > 0.9
    error = np.stack([slopes.x, slopes.y], axis=-1) - record.truth
    noise_px = 1.5 / np.sqrt(case.flux_e) * case.fwhm_px  # about three times the photon limit, FWHM / 2.355
    assert np.median(np.abs(error[slopes.valid])) < noise_px


def test_unmoved_spots_have_the_slopes_of_the_pipeline() -> None:
    record = recording(2003, Case(frames=5, pitches=0.01, jitter=0.0, missing=0.0))
    slopes, plain = followed(record), record.pipeline()(record.frames)
    for name in ("x", "y", "flux", "standard_error_x", "covariance_xy"):
        np.testing.assert_allclose(getattr(slopes, name), getattr(plain, name), rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(slopes.flags, plain.flags)


def test_one_frame_at_a_time_is_the_same() -> None:
    record = recording(2004, Case(frames=6))
    together, follower = followed(record), fs.SpotFollower(record.pipeline())
    for number, frame in enumerate(record.frames):
        one = follower(frame)
        assert one.x.shape == together.x.shape[1:]
        np.testing.assert_array_equal(one.x, together.x[number])
        np.testing.assert_array_equal(one.flags, together.flags[number])


def test_reference_positions_are_subtracted() -> None:
    record = recording(2005, Case(frames=10))
    pipeline = record.pipeline()
    reference = np.random.default_rng(1).uniform(-4, 4, (len(record.layout), 2))
    moved = fs.SlopePipeline(record.layout, pipeline.settings, pipeline.calibration, reference)
    plain, slopes = followed(record), fs.SpotFollower(moved)(record.frames)
    both = plain.valid & slopes.valid
    assert both.mean() > 0.9
    np.testing.assert_allclose(
        (plain.x - slopes.x)[both], np.broadcast_to(reference[:, 0], both.shape)[both], atol=0.3
    )


def test_lost_spots_are_found_again() -> None:
    record = recording(2006, Case(frames=30, missing=0.0))
    gone = 10, slice(8, 16)
    frames = record.frames.copy()
    x, y = (record.layout.centres[gone[0]] + record.truth[gone[1], gone[0]]).T.round().astype(int)
    for frame, row, column in zip(frames[gone[1]], y, x, strict=True):
        part = frame[row - 6 : row + 7, column - 6 : column + 7]
        part[:] = np.random.default_rng(row).normal(0.0, 3.0, part.shape)
    slopes = fs.SpotFollower(record.pipeline())(frames)
    assert (slopes.flags[gone[1], gone[0]] & int(FLAG.NO_FLUX)).all()
    assert not slopes.valid[gone[1], gone[0]].any()
    assert slopes.valid[16:, gone[0]].all()
    assert share_of_wrong(record, slopes) <= MOST_WRONG


def frames_of(layout: fs.Layout, truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return frames without noise of spots displaced by x, y (n_frames, n, 2)."""
    y, x = np.mgrid[: layout.frame_shape[0], : layout.frame_shape[1]]
    at = layout.centres + truth
    away = (x - at[..., 0, None, None]) ** 2 + (y - at[..., 1, None, None]) ** 2
    return np.asarray(100.0 * np.exp(-0.3 * away).sum(axis=1))


def test_crossing_spots_are_both_flagged_while_they_cross() -> None:
    """The spots 12 and 13 come as near as 1 px and part again."""
    layout = fs.Layout.grid((5, 5), pixels=16, origin=(16, 16), frame_shape=(112, 112))
    truth = np.zeros((25, 25, 2))
    truth[:, 12, 0] = 7.5 * np.sin(np.linspace(0.0, np.pi, 25))
    truth[:, 13, 0] = -truth[:, 12, 0]
    frames = frames_of(layout, truth)
    slopes = fs.SpotFollower(fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=12)))(frames)
    middle = len(frames) // 2
    assert (slopes.flags[middle, [12, 13]] & int(FLAG.UNLIKE_NEIGHBOURS)).all()
    assert slopes.valid[[0, -1]].all()
    np.testing.assert_allclose(slopes.x[-1], truth[-1, :, 0], atol=0.1)


@pytest.mark.slow
def test_spots_beyond_the_frame_are_not_valid() -> None:
    record = recording(2007, Case(frames=40, order=1, pitches=1.5, missing=0.0))
    top = int(record.layout.corners[:, 0].min())
    layout = replace(
        record.layout,
        frame_shape=(record.layout.frame_shape[0] - top, record.layout.frame_shape[1]),
        corners=record.layout.corners - np.array([top, 0]),
        centres=record.layout.centres - [0, top],
    )
    cut = replace(record, layout=layout, frames=np.ascontiguousarray(record.frames[:, top:]))
    slopes = followed(cut)
    assert share_of_wrong(cut, slopes) <= MOST_WRONG
    beyond = (layout.centres + cut.truth)[..., 1] < -3
    assert beyond.any() or record.truth[-1, 0, 1] > 0
    assert not slopes.valid[beyond].any()


def test_an_ambiguous_first_frame_has_no_valid_slope() -> None:
    """Half a pitch to one side looks like half a pitch to the other where the array goes on."""
    array = fs.Layout.grid((9, 9), pixels=16, origin=(16, 16), frame_shape=(176, 176))
    layout = array[(np.abs(array.cells - 4) <= 2).all(axis=1)]
    pipeline = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=12))
    slightly, half = frames_of(array, np.array([[[4.0, 0.0]], [[8.0, 0.0]]]))
    assert fs.SpotFollower(pipeline)(slightly).valid.all()
    slopes = fs.SpotFollower(pipeline)(half)
    assert not slopes.valid.any()
    assert (slopes.flags[slopes.measured] & int(FLAG.UNLIKE_NEIGHBOURS)).all()


def test_binned_frames_are_followed() -> None:
    record = recording(2008, Case(frames=10, missing=0.0))
    big = record.frames.repeat(2, axis=1).repeat(2, axis=2) / 4
    pipeline = record.pipeline()
    layout = magnified_layout(record.layout, 2, big.shape[1:])
    settings = pipeline.settings.magnified(2)
    camera = fs.Calibration(read_noise_e=1.5, saturation_adu=1.01 * float(big.max()))
    binned = fs.SpotFollower(fs.SlopePipeline(layout, settings, camera))(big)
    plain = followed(record)
    both = plain.valid & binned.valid
    assert both.mean() > 0.9
    np.testing.assert_allclose(binned.x[both], 2 * plain.x[both], atol=0.05)
    assert not (binned.flags & int(FLAG.SATURATED)).any()  # sums of four pixels are above it


def test_empty_and_broken_frames_do_not_move_the_windows() -> None:
    record = recording(2009, Case(frames=12, missing=0.0))
    frames = record.frames.copy()
    frames[4], frames[5] = np.nan, 0.0
    slopes = fs.SpotFollower(record.pipeline())(frames)
    assert not slopes.valid[4:6].any()
    assert np.isfinite(slopes.x).all()
    rest = np.delete(np.arange(12), [4, 5])
    assert slopes.valid[rest].mean() > 0.9
    assert np.mean(record.is_wrong(slopes)[rest][slopes.valid[rest]]) <= MOST_WRONG


def test_saturated_pixels_are_flagged_where_the_spot_is() -> None:
    record = recording(2010, Case(frames=20, missing=0.0))
    pipeline = record.pipeline()
    camera = replace(pipeline.calibration, saturation_adu=100.0)
    slopes = fs.SpotFollower(fs.SlopePipeline(record.layout, pipeline.settings, camera))(record.frames)
    assert np.mean((slopes.flags & int(FLAG.SATURATED)) != 0) > 0.95


def test_what_is_refused() -> None:
    settings = fs.Settings("brightest", keep_brightest=9)
    layout = fs.Layout.grid((4, 4), pixels=8)
    for unusable in (layout[:3], replace(layout, pitch_px=None)):
        with refused("at least 4 sub-apertures with pitch_px"):
            fs.SpotFollower(fs.SlopePipeline(unusable, settings))
    with refused("frame: expected shape"):
        fs.SpotFollower(fs.SlopePipeline(layout, settings))(np.zeros((7, 7)))
