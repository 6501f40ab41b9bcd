import asyncio
import json
import socket
from typing import Any

import pytest
from tests.refusals import refused

pytest.importorskip("tornado")
pytest.importorskip("zarr")

from tests.engine.page.cases import LAYOUT, Client, Noted, Played, asked, connected, next_of, served
from tornado.httpclient import AsyncHTTPClient, HTTPClientError

from faintspot.engine.page import server as server_module
from faintspot.engine.page.client_requests import Access
from faintspot.engine.page.server import LARGEST_REQUEST, MOST_CLIENTS, LiveServer


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pauses: they are for people."""
    monkeypatch.setattr(server_module, "UPDATE_S", 0.01)
    monkeypatch.setattr(server_module, "_REST_S", 0.005)
    monkeypatch.setattr(server_module, "_WRONG_TOKEN_S", 0.01)
    monkeypatch.setattr(server_module, "_PAUSE_S", 0.001)


def noted(server: LiveServer) -> list[dict[str, Any]]:
    assert isinstance(server.client_requests, Noted)
    return server.client_requests.asked


async def status_of(server: LiveServer, path: str = "/", **headers: str) -> int:
    url = f"http://127.0.0.1:{server.port}{path}"
    response = await AsyncHTTPClient().fetch(url, headers=headers, raise_error=False)
    return int(response.code)


async def refused_with(server: LiveServer, **headers: str) -> int:
    with pytest.raises(HTTPClientError) as refused:
        await connected(server, **headers)
    return int(refused.value.code)


async def closed(client: Client) -> int:
    while await client.read() is not None:
        pass
    return client.close_code


async def two_friends(server: LiveServer) -> tuple[Client, Client]:
    """Two clients that have the token."""
    friends = await connected(server), await connected(server)
    for client in friends:
        await asked(client, do="hello", token=server.access.token)
    return friends


def test_page_and_its_files_need_nothing_else() -> None:
    async def check(server: LiveServer) -> None:
        url = f"http://127.0.0.1:{server.port}/"
        page = await AsyncHTTPClient().fetch(url)
        assert page.headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'")
        assert page.headers["X-Content-Type-Options"] == "nosniff"
        assert b"<script type=" in page.body
        assert b"http://" not in page.body
        assert b"https://" not in page.body
        for name, kind in (("page.js", "text/javascript"), ("page.css", "text/css")):
            content = await AsyncHTTPClient().fetch(url + name)
            assert content.headers["Content-Type"].startswith(kind)
            assert b"https://" not in content.body
        for path in ("/nothing.js", "/../server.py", "/%2e%2e/server.py", "/__init__.py", "/etc/passwd"):
            assert await status_of(server, path) == 404

    served(check)


HOSTS = [
    "example.org", "example.org:80", "127.0.0.1.example.org", "[", "", "a:b:c", "[::1]example.org",
    "[::1].example.org:80", "127.0.0.1:80.example.org", "127.0.0.1:80@example.org", "localhost:",
    "[127.0.0.1]",
]  # fmt: skip
ORIGINS = "http://example.org", "http://127.0.0.1:1", "null", "", "https://127.0.0.1"
GARBAGE: list[str | bytes] = [
    "", "{", "[]", "null", '"hello"', "1e999", '{"do": 5}', '{"token": "x"}', "[" * 5000, "\x00\ud7ff",
    b"\xff\xfe", b"", '{"do": "set", "id": NaN}', '{"do": "set", "id": -1e999}',
    '{"do": "set", "id": "\\ud800"}', '{"do": "hello", "token": "\\udfff"}',
    '{"do": "set", "a": [{"b": NaN}]}', json.dumps({"do": "set", "changes": "x" * LARGEST_REQUEST}),
]  # fmt: skip


def test_forged_hosts_and_origins_are_refused() -> None:
    """A port that was forwarded is the same host."""
    headers = {"Host": "127.0.0.1:8642", "Origin": "http://127.0.0.1:8642"}
    assert Access.permits_origin(headers)
    for suffix in (".example.org", "@example.org", "0", "/", "/page", " "):
        assert not Access.permits_origin(headers | {"Origin": headers["Origin"] + suffix})

    async def check(server: LiveServer) -> None:
        for host in HOSTS:
            assert await status_of(server, "/", Host=host) in (400, 403), host
            assert await refused_with(server, Host=host, Origin=f"http://{host}") in (400, 403), host
        for origin in (*ORIGINS, f"http://127.0.0.1:{server.port}.example.org"):
            assert await refused_with(server, Origin=origin) == 403, origin
        connection = await connected(server, Host="localhost:9000", Origin="http://localhost:9000")
        assert (await asked(connection, do="hello"))["ok"]

    served(check)


def test_garbage_closes_that_client_alone(caplog: pytest.LogCaptureFixture) -> None:
    async def check(server: LiveServer) -> None:
        good, *_ = await two_friends(server)
        for garbage in GARBAGE:
            bad = await connected(server)
            await asked(bad, do="hello", token=server.access.token)
            await bad.send(garbage)
            assert await closed(bad) in (1006, 1007, 1008, 1009), garbage[:40]
            assert (await asked(good, do="set"))["ok"]
        await next_of(good, "now")

    assert len(noted(served(check))) == len(GARBAGE)
    assert not caplog.records


def test_watching_needs_no_token_here_and_changes_do() -> None:
    async def check(server: LiveServer) -> None:
        watcher = await connected(server)
        assert await asked(watcher, do="hello") == {"id": 7, "ok": True, "may_change": False}
        values, _ = await next_of(watcher, "sensor")
        assert values["subapertures"] == len(LAYOUT)
        values, arrays = await next_of(watcher, "now")
        later, _ = await next_of(watcher, "now")
        assert later["frame"] > values["frame"]
        assert arrays["x"].shape == (len(LAYOUT),)
        _, pictures = await next_of(watcher, "pictures")
        assert pictures["raw"].shape == LAYOUT.frame_shape
        refused = await asked(watcher, do="set", changes=["noise_std=1"])
        assert not refused["ok"]
        assert "token" in refused["error"]
        wrong = await asked(watcher, do="hello", token="guess")
        assert not wrong["ok"]
        assert not (await asked(watcher, do="set"))["ok"]
        right = await asked(watcher, do="hello", token=server.access.token)
        assert right["may_change"]
        assert (await asked(watcher, do="set", changes=["noise_std=1"]))["text"] == "noted"
        unknown = await asked(watcher, do="format")
        assert unknown["error"].startswith("do = 'format': expected one of set")

    assert [request["changes"] for request in noted(served(check))] == [["noise_std=1"]]


def test_bound_elsewhere_even_reading_needs_the_token() -> None:
    async def check(server: LiveServer) -> None:
        for token in (None, "", "guess", 5, ["a"]):
            stranger = await connected(server)
            answer = await asked(stranger, do="hello", token=token)
            assert not answer["ok"]
            assert await closed(stranger) == 1008
        friend = await connected(server)
        assert (await asked(friend, do="hello", token=server.access.token))["may_change"]
        await next_of(friend, "now")

    served(check, address="0.0.0.0")


def test_a_stranger_who_says_nothing_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "_HELLO_S", 0.1)

    async def check(server: LiveServer) -> None:
        silent = await connected(server)
        assert await closed(silent) == 1008
        while server.clients:
            await asyncio.sleep(0.01)

    served(check)


def test_errors_are_logged_at_the_servers_pace(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(value: object) -> None:
        raise RuntimeError("a fault")

    monkeypatch.setattr(server_module, "to_json", fail)
    monkeypatch.setattr(server_module, "_rate_limit", server_module._RateLimit())

    async def check(server: LiveServer) -> None:
        for _ in range(20):
            client = await connected(server)
            await client.send(json.dumps({"do": "hello"}))
            while await client.read() is not None:
                pass

    served(check)
    assert len(caplog.records) == 1


def test_flood_is_answered_one_by_one_and_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "_PAUSE_S", 0.05)

    async def check(server: LiveServer) -> None:
        good, bad = await two_friends(server)
        for _ in range(500):
            await bad.send(json.dumps({"do": "set"}))
        for _ in range(20):
            await next_of(good, "now")
        assert (await asked(good, do="set"))["ok"]
        bad.close()

    assert len(noted(served(check))) < 100


def test_more_clients_than_there_is_room_for_are_refused() -> None:
    async def check(server: LiveServer) -> None:
        clients = [await connected(server) for _ in range(MOST_CLIENTS)]
        assert await refused_with(server) == 503
        clients[0].close()
        while len(server.clients) == MOST_CLIENTS:
            await asyncio.sleep(0.01)
        await connected(server)

    served(check)


def test_port_that_is_taken_and_no_address() -> None:
    async def check(server: LiveServer) -> None:
        with refused(f"127.0.0.1:{server.port}"):
            LiveServer(Played(), Noted(), Access("127.0.0.1"), port=server.port)
        assert server.url == f"http://127.0.0.1:{server.port}/#{server.access.token}"  # no server sees it
        assert len(server.access.token) >= 32

    served(check)
    with refused("bind = 'here'"):
        Access("here")
    access = Access("127.0.0.1")
    assert access.permits_host(f"{socket.gethostname()}:8642")
    assert access.permits_host("[::1]:8642")
    assert not access.permits_host(None)
