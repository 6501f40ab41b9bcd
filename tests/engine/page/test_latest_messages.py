import asyncio

from faintspot.engine.page.page import LatestMessages


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
