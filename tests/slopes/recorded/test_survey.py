"""First look at recorded frames."""

from pathlib import Path

import numpy as np

from faintspot.io.frames import open_frames
from faintspot.slopes.recorded.survey import UsualFrames, frames_apart, stretches


def test_frames_unlike_most_and_repeated_ones_are_known_across_blocks() -> None:
    frames = np.random.default_rng(1).normal(10.0, 1.0, (8, 20, 20))
    frames[2] = 10 + 5 * (frames[2] - 10)
    frames[6] = frames[5]
    looked = UsualFrames()
    for block in np.split(frames, 4):
        assert looked.seen(block) is block
    assert np.flatnonzero(looked.unlike).tolist() == [2]
    assert np.flatnonzero(looked.repeated).tolist() == [6]


def test_frames_apart_are_every_eighth_of_the_stretches(tmp_path: Path) -> None:
    """Of 1025 frames 20 stretches of 50, which overlap nowhere; each frame has its number."""
    frames = np.broadcast_to(np.arange(1025, dtype=np.uint16)[:, None, None], (1025, 4, 4))
    np.save(tmp_path / "frames.npy", frames)
    with open_frames([tmp_path / "frames.npy"]) as source:
        every = np.concatenate([block[:, 0, 0] for block in stretches(source)])
        apart = np.concatenate([block[:, 0, 0] for block in frames_apart(source)])
    assert len(every) == 1000
    np.testing.assert_array_equal(apart, every.reshape(20, 50)[:, ::8].ravel())
