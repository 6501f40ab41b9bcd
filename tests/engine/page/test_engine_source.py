import numpy as np
import pytest

pytest.importorskip("pyshmem")

from tests.engine.page.cases import next_batch
from tests.engine.telemetry_cases import LAYOUT, as_written, write, write_images

from faintspot.engine.page.engine_source import EngineSource
from faintspot.engine.streams.shared_streams import create_stream
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.engine.telescope import TRUTH


def test_engine_that_comes_goes_and_comes_back(name: str) -> None:
    source = EngineSource(name)
    assert source.read() is None
    assert not source.state()["there"]
    for methods in ([], ["none", "tv"]):
        with TelemetryRing.create(name, LAYOUT, methods=methods) as ring:
            first = next_batch(source)
            assert first.anew
            assert source.methods == methods
            for frame in range(5):
                write(ring, frame)
            write_images(ring, 3)
            ring.write_change(2, 1, {"noise_std": 2.0}, None)
            batch = next_batch(source)
            assert not batch.anew
            assert batch.records["frame"].tolist() == [0, 1, 2, 3, 4]
            assert as_written(batch.records)
            assert batch.picture is not None
            assert batch.picture.frame == 3
            assert batch.picture.raw[0, 0] == 3
            assert [change["changes"] for change in batch.changes] == [{"noise_std": 2.0}]
            again = next_batch(source)
            assert again.picture is None
            assert not len(again.records)
        source.read()
        assert source.read() is None
        assert not source.state()["there"]
    source.close()


def test_truth_and_commands_of_streams(name: str) -> None:
    source = EngineSource(name)
    with TelemetryRing.create(name, LAYOUT):
        truth, commands = (
            create_stream(f"{name}_truth", (len(TRUTH),)),
            create_stream(f"{name}_commands", (3,)),
        )
        values = dict.fromkeys(TRUTH, 0.0) | {"frame": 7.0, "strehl": 0.5, "rms_nm": 150.0, "time_s": 0.06}
        truth.write(np.array(list(values.values())), frame_id=7)
        commands.write(np.array([1.0, -2.0, 3.0]), frame_id=7)
        batch = next_batch(source)
        assert batch.truth == (7, 0.5, 150.0)
        assert source.state()["camera_hz"] == 125.0  # 0.06 s is the middle of frame 7
        assert batch.commands is not None
        assert batch.commands.tolist() == [1.0, -2.0, 3.0]
        again = next_batch(source)
        assert again.truth is None
        truth.unlink()
        commands.unlink()
    source.close()
