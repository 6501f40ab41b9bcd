import asyncio
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.engine.page.cases import unpacked

import faintspot as fs
from faintspot.engine.page.page import LatestMessages, packed, settings_rows
from faintspot.slopes.pipeline.settings import SharedOptions


def test_message_holds_values_and_arrays_as_they_were() -> None:
    arrays: dict[str, NDArray[Any]] = {
        "odd": np.arange(5, dtype=np.uint8),
        "none": np.zeros((0, 3), np.float32),
        "table": np.arange(6.0).reshape(2, 3),
        "strided": np.arange(8, dtype=np.int32)[::2],
    }
    kind, values, found = unpacked(packed("now", {"é": 1, "missing": float("nan")}, arrays))
    assert (kind, values) == ("now", {"é": 1, "missing": None})
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_only_the_newest_message_of_each_kind_is_kept() -> None:
    async def check() -> None:
        latest_messages = LatestMessages()
        for number in range(100):
            latest_messages.post("now", b"now %d" % number)
            if number == 50:
                latest_messages.post("sensor", b"sensor")
        messages = await latest_messages.newer(0)
        assert [text for _, text in messages] == [b"sensor", b"now 99"]
        waiting = asyncio.ensure_future(latest_messages.newer(messages[-1][0]))
        await asyncio.sleep(0)
        assert not waiting.done()
        latest_messages.post("now", b"next")
        assert [text for _, text in await waiting] == [b"next"]

    asyncio.run(check())


def test_what_was_taken_down_is_not_given_to_those_who_come_later() -> None:
    async def check() -> None:
        latest_messages = LatestMessages()
        latest_messages.post("pictures", b"old")
        waiting = asyncio.ensure_future(latest_messages.newer(1))
        await asyncio.sleep(0)
        latest_messages.post("pictures", b"newer")
        latest_messages.forget("pictures")
        latest_messages.forget("pictures")
        await asyncio.sleep(0)
        assert not waiting.done()
        latest_messages.post("now", b"now")
        assert [text for _, text in await waiting] == [b"now"]

    asyncio.run(check())


def test_every_setting_is_a_row_of_the_form() -> None:
    values = {
        "estimator": "tv",
        "noise_std": 2.5,
        "rule": "subtract_next",
        "flux_e": None,
        "search_range_px": 3,
    }
    rows = {row["name"]: row for row in settings_rows(values)}
    assert list(rows) == list(values)
    assert "ml" in rows["estimator"]["choices"]
    assert rows["noise_std"]["value"] == "2.5"
    assert "noise" in rows["noise_std"]["meaning"]
    assert rows["rule"]["choices"][0] == "subtract_next"
    assert rows["flux_e"]["value"] == "none"


def test_values_of_subapertures_are_told_by_their_ends() -> None:
    def text(value: list[float]) -> str:
        (row,) = settings_rows({"noise_std": value})
        return str(row["value"])

    assert text([2.0] * 36) == "2"
    assert text([1.0, 2.5]) == "1,2.5"
    assert text([float(i) for i in range(36)]) == "(36 values, 0 to 35)"


def test_what_an_engine_answers_can_be_set_again() -> None:
    """The form's texts, parsed as `realtime send` parses them, are the settings."""
    from faintspot.base.tables import parse_changes

    settings = fs.Settings(estimator="ml", search_range_px=2.5)
    names = [*settings.estimator.declared(), *SharedOptions.declared()]
    values = {name: getattr(settings, name) for name in names}
    rows = settings_rows({"estimator": "ml", **values})
    changes = parse_changes([f"{row['name']}={row['value']}" for row in rows])
    assert fs.Settings(**changes) == settings
