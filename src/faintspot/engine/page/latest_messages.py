"""The newest message of each kind, for clients that read at their own pace."""

from __future__ import annotations

import asyncio


class LatestMessages:
    """One message of each kind; a newer one replaces it whether or not it has been read.

    A slow client misses messages, and nothing is queued for it. For use in one event loop.
    """

    def __init__(self) -> None:
        self._messages: dict[str, tuple[int, bytes]] = {}
        self._posted = 0
        self._changed = asyncio.Event()

    def post(self, kind: str, message: bytes) -> None:
        """Set the message of a kind."""
        self._posted += 1
        self._messages[kind] = self._posted, message
        self._changed.set()
        self._changed = asyncio.Event()

    def forget(self, kind: str) -> None:
        """Remove the message of a kind: later clients do not get it."""
        self._messages.pop(kind, None)

    async def newer(self, last: int) -> list[tuple[int, bytes]]:
        """Wait for messages posted after number `last`; return them with their numbers, in order."""
        while not (messages := sorted(item for item in self._messages.values() if item[0] > last)):
            await self._changed.wait()
        return messages
