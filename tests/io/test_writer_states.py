"""Slope files against a plain model: a list of frames, of which a killed process may lose the last."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
)
from tests.io.slope_files import append_copy, assert_stored, part, result, store_of, writer_for
from tests.patience import try_states
from tests.refusals import refused

from faintspot.io import SlopeWriter, read_slopes, slopes_writer
from faintspot.io.formats import zarr_files

FRAMES = 30
WHOLE = result(FRAMES)


class SlopeFiles(RuleBasedStateMachine):
    """Append, close, kill, resume, and read at any time."""

    writer: SlopeWriter | None = None
    appended = kept = copies = 0
    """Frames that were given to the writer, and those that no end of the process may lose."""

    @initialize(name=st.sampled_from(["slopes.npz", "slopes.zarr"]))
    def begin(self, name: str) -> None:
        self.folder = Path(tempfile.mkdtemp())
        self.name = name

    @property
    def path(self) -> Path:
        return self.folder / str(self.copies) / self.name

    @precondition(lambda self: self.writer is None)
    @rule()
    def open(self) -> None:
        self.path.parent.mkdir(exist_ok=True)
        self.writer = writer_for(self.path, FRAMES)
        assert self.kept <= self.writer.finished() <= self.appended
        self.appended = self.kept = self.writer.finished()

    @precondition(lambda self: self.writer is not None and self.appended < FRAMES)
    @rule(count=st.integers(1, 13))
    def append(self, count: int) -> None:
        assert self.writer is not None
        stop = min(self.appended + count, FRAMES)
        append_copy(self.writer, self.appended, part(WHOLE, self.appended, stop))
        self.appended = stop

    @precondition(lambda self: self.writer is not None and self.appended < FRAMES)
    @rule(ahead=st.sampled_from([-1, 1, 7]))
    def append_at_another_frame(self, ahead: int) -> None:
        assert self.writer is not None
        with refused("frame"):
            self.writer.append(self.appended + ahead, part(WHOLE, 0, 1))

    @precondition(lambda self: self.writer is not None)
    @rule()
    def close(self) -> None:
        assert self.writer is not None
        self.writer.close()
        self.writer, self.kept = None, self.appended
        if self.kept == FRAMES:
            assert_stored(self.path, WHOLE)

    @rule()
    def kill(self) -> None:
        """Go on with what is on the disk, as a process would that begins after this one was killed."""
        before = self.path.parent
        self.copies += 1
        if before.exists():
            shutil.copytree(before, self.path.parent)
        if self.writer is not None:
            self.writer.close()
        self.writer = None

    @invariant()
    def what_is_read_is_what_was_appended(self) -> None:
        if self.copies or self.writer is not None or self.kept:
            store = self.path if self.path.is_file() else store_of(self.path)
            if store.exists():
                stored = read_slopes(store)
                assert self.kept <= stored.n_finished <= self.appended
                for name, values in WHOLE.items():
                    np.testing.assert_array_equal(stored.variables[name], values[: stored.n_finished])

    def teardown(self) -> None:
        if self.writer is not None:
            self.writer.close()
        if hasattr(self, "folder"):
            shutil.rmtree(self.folder)


@pytest.mark.hypothesis
@pytest.mark.parametrize("mark_s", [0.0, 1e9], ids=["marks at once", "marks at the end"])
def test_slope_files_are_what_was_appended(monkeypatch: pytest.MonkeyPatch, mark_s: float) -> None:
    monkeypatch.setattr(zarr_files, "_CHUNK_NUMBERS", 70)
    monkeypatch.setattr(slopes_writer, "_MARK_SECONDS", mark_s)
    try_states(SlopeFiles, 2, 12)
