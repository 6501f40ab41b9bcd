from __future__ import annotations

import asyncio

from faintspot.live_page.board import Board


def test_only_the_newest_message_of_each_kind_is_kept() -> None:
    async def check() -> None:
        board = Board()
        for number in range(100):
            board.post("now", b"now %d" % number)
            if number == 50:
                board.post("sensor", b"sensor")
        messages = await board.newer(0)
        assert [text for _, text in messages] == [b"sensor", b"now 99"]
        waiting = asyncio.ensure_future(board.newer(messages[-1][0]))
        await asyncio.sleep(0)
        assert not waiting.done()
        board.post("now", b"next")
        assert [text for _, text in await waiting] == [b"next"]

    asyncio.run(check())


def test_what_was_taken_down_is_not_given_to_those_who_come_later() -> None:
    async def check() -> None:
        board = Board()
        board.post("pictures", b"old")
        waiting = asyncio.ensure_future(board.newer(1))
        await asyncio.sleep(0)
        board.post("pictures", b"newer")
        board.forget("pictures")
        board.forget("pictures")
        await asyncio.sleep(0)
        assert not waiting.done()
        board.post("now", b"now")
        assert [text for _, text in await waiting] == [b"now"]

    asyncio.run(check())
