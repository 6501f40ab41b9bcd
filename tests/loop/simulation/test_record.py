from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from tests.loop.simulation.loop_cases import faint, plain
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.loop.simulation import LoopRecord, simulate_loop

skip_without("hcipy")


@pytest.fixture(scope="module")
def record() -> LoopRecord:
    return simulate_loop(
        faint().replace("run", frames=12, settle_frames=4), [plain("a"), plain("b")], [0, 1] * 6
    )


def test_a_record_comes_back_as_it_was(record: LoopRecord, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    record.save(path)
    again = LoopRecord.load(path)
    for item in fields(LoopRecord):
        old, new = getattr(record, item.name), getattr(again, item.name)
        assert type(old) is type(new), item.name
        np.testing.assert_array_equal(old, new)
        if isinstance(old, np.ndarray):
            assert old.dtype == new.dtype
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_mean_strehl_is_of_scored_frames(record: LoopRecord) -> None:
    assert record.mean_strehl(1) == pytest.approx(record.strehl[5::2].mean())
    with refused("method = 2"):
        record.mean_strehl(2)


def test_files_that_cannot_be_read_or_written_are_named(record: LoopRecord, tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", a=1)
    for name in ("none.npz", "text.npz", "other.npz"):
        with refused(name):
            LoopRecord.load(tmp_path / name)
    with refused("nowhere"):
        record.save(tmp_path / "nowhere" / "run.npz")
