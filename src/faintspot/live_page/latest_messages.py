"""The newest message of every kind, for clients that take them at their own pace."""

from __future__ import annotations

import asyncio


class LatestMessages:
    """Holds one message of each kind; a newer one replaces it, whoever has read it or not.

    So a client that is slow misses messages, and nothing is kept for it. For one event loop.
    """

    def __init__(self) -> None:
        self._messages: dict[str, tuple[int, bytes]] = {}
        self._posted = 0
        self._changed = asyncio.Event()

    def post(self, kind: str, message: bytes) -> None:
        """Put up a message."""
        self._posted += 1
        self._messages[kind] = self._posted, message
        self._changed.set()
        self._changed = asyncio.Event()

    def forget(self, kind: str) -> None:
        """Take a message down: those who come later do not get it."""
        self._messages.pop(kind, None)

    async def newer(self, seen: int) -> list[tuple[int, bytes]]:
        """Wait for messages posted after number `seen`; return them with their numbers, in order."""
        while not (messages := sorted(item for item in self._messages.values() if item[0] > seen)):
            await self._changed.wait()
        return messages
