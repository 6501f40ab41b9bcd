"""Clients of the page that come, go and lag, against a plain model, without sockets."""

import asyncio
import json
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from tests.engine.page.cases import Noted
from tests.patience import try_states
from tornado.websocket import WebSocketClosedError

from faintspot.engine.page import server as server_module
from faintspot.engine.page.client_requests import Access
from faintspot.engine.page.page import LatestMessages
from faintspot.engine.page.server import Client

KINDS = "now", "pictures", "sensor"
GARBAGE = b"{}", "{", "[]", '{"do": 1}', '{"do": "\\ud800"}'
WORDS: dict[str, dict[str, Any]] = {
    "right": {"do": "hello", "token": True},
    "wrong": {"do": "hello", "token": "guessed"},
    "nothing": {"do": "hello"},
    "wish": {"do": "set"},
    "wish with the token": {"do": "set", "token": True},
}


class Played(Client):
    """A client whose messages are kept, and taken only while it does not lag."""

    def __init__(self, server: Any) -> None:
        self.server = server
        self.numbers: list[int] = []
        """Of the messages that came."""
        self.answers: list[dict[str, Any]] = []
        self.waits: asyncio.Future[None] | None = None
        self.lags = self.is_closed = False
        self.is_greeted = self.knows_token = False
        """As it ought to be."""

    async def write_message(  # type: ignore[override]
        self, message: Any, binary: bool = False
    ) -> None:
        if self.is_closed:
            raise WebSocketClosedError
        if not binary:
            self.answers.append(json.loads(message))
            return
        assert self.waits is None
        if self.lags:
            self.waits = asyncio.get_running_loop().create_future()
            await self.waits
        self.numbers.append(int(message))

    def close(self, code: int | None = None, reason: str | None = None) -> None:
        if not self.is_closed:
            self.is_closed = True
            self.on_close()


class Clients(RuleBasedStateMachine):
    """The newest message of each kind, and who gets it."""

    def __init__(self) -> None:
        super().__init__()
        self.loop = asyncio.new_event_loop()
        self.clients: list[Played] = []
        self.newest: dict[str, int] = {}
        self.posted = self.wishes = 0

    @initialize(private=st.booleans())
    def begin(self, private: bool) -> None:
        self.private, self.noted = private, Noted()
        self.server = SimpleNamespace(
            access=Access("127.0.0.1", private),
            latest_messages=LatestMessages(),
            client_requests=self.noted,
            clients=set(),
        )

    def settle(self) -> None:
        """Let everybody do what they can."""
        for _ in range(20):
            self.loop.run_until_complete(asyncio.sleep(0))

    @rule(kind=st.sampled_from(KINDS))
    def post(self, kind: str) -> None:
        self.posted += 1
        self.newest[kind] = self.posted
        self.server.latest_messages.post(kind, str(self.posted).encode())
        self.settle()

    @rule(kind=st.sampled_from(KINDS))
    def forget(self, kind: str) -> None:
        self.newest.pop(kind, None)
        self.server.latest_messages.forget(kind)

    @precondition(lambda self: len(self.clients) < 3)
    @rule()
    def come(self) -> None:
        client = Played(self.server)
        self.clients.append(client)
        self.loop.call_soon(client.open)
        self.settle()

    @precondition(lambda self: self.clients)
    @rule(who=st.integers(0, 9))
    def go(self, who: int) -> None:
        client = self.clients.pop(who % len(self.clients))
        client.close()
        self.settle()

    @precondition(lambda self: self.clients)
    @rule(who=st.integers(0, 9), words=st.sampled_from(list(WORDS)))
    def say(self, who: int, words: str) -> None:
        client = self.clients[who % len(self.clients)]
        said = {"id": self.posted, **WORDS[words]}
        if said.get("token") is True:
            said["token"] = self.server.access.token
        greets, is_right = said["do"] == "hello" or not client.is_greeted, words == "right"
        is_new = not client.is_greeted
        if greets:
            may = is_right or not self.private
            client.is_greeted |= may
            client.knows_token |= is_right
            is_well = may and (is_right or "token" not in said)
        else:
            is_well = client.knows_token
            self.wishes += is_well
        self.loop.run_until_complete(client.on_message(json.dumps(said)))
        self.settle()
        assert client.answers[-1]["id"] == said["id"]
        assert client.answers[-1]["ok"] == is_well
        assert len(self.noted.asked) == self.wishes
        assert client.is_closed == (not client.is_greeted)
        if is_new and client.is_greeted and not client.lags:
            assert client.numbers == sorted(self.newest.values())
        if client.is_closed:
            self.clients.remove(client)

    @precondition(lambda self: self.clients)
    @rule(who=st.integers(0, 9), garbage=st.sampled_from(GARBAGE))
    def say_garbage(self, who: int, garbage: Any) -> None:
        client = self.clients.pop(who % len(self.clients))
        self.loop.run_until_complete(client.on_message(garbage))
        assert client.is_closed

    @precondition(lambda self: self.clients)
    @rule(who=st.integers(0, 9))
    def lag(self, who: int) -> None:
        self.clients[who % len(self.clients)].lags = True

    @precondition(lambda self: self.clients)
    @rule(who=st.integers(0, 9), in_time=st.booleans())
    def catch_up(self, who: int, in_time: bool) -> None:
        client = self.clients[who % len(self.clients)]
        client.lags = False
        waits, client.waits = client.waits, None
        if waits is not None and in_time:
            waits.set_result(None)
        elif waits is not None:
            waits.set_exception(TimeoutError())
        self.settle()
        if waits is not None and not in_time:
            assert client.is_closed
            self.clients.remove(client)

    @invariant()
    def each_message_comes_once_in_order_to_those_who_may_read(self) -> None:
        for client in self.clients:
            assert client.numbers == sorted(set(client.numbers))
            assert client.is_greeted or not client.numbers
            if client.is_greeted and not client.lags:
                assert set(self.newest.values()) <= set(client.numbers)
        if self.clients:
            assert self.server.clients == set(self.clients)

    def teardown(self) -> None:
        for client in self.clients:
            client.close()
        self.settle()
        self.loop.close()


@pytest.mark.hypothesis
def test_clients_get_the_newest_messages_and_change_with_the_token_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def at_once(work: Any) -> Any:
        return work()

    for name in ("_WRONG_TOKEN_S", "_PAUSE_S"):
        monkeypatch.setattr(server_module, name, 0.0)
    monkeypatch.setattr(server_module, "_in_thread", at_once)
    try_states(Clients, 30, 25)
