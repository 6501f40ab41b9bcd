"""The page in a real browser: Chromium as the distribution has it, without a window."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("playwright.sync_api")
pytest.importorskip("tornado")
pytest.importorskip("pyshmem")
pytest.importorskip("zarr")

from playwright.sync_api import sync_playwright
from tests.engine.bench import Bench, simulated

from faintspot.base.checks import number_between
from faintspot.engine.page.server import LiveServer, serve
from faintspot.engine.processes.requests import ControlServer, socket_path
from faintspot.engine.request_handlers import LENGTHY, commands_of
from faintspot.io.telemetry import read_telemetry

CHROMIUM = next((found for name in ("chromium", "chromium-browser") if (found := shutil.which(name))), None)
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt install chromium"),
    pytest.mark.slow,
]
PATIENCE_MS = 30_000
DESKTOP, TELEPHONE = {"width": 1400, "height": 900}, {"width": 360, "height": 740}


class Running(Bench):
    """An engine, its control channel, and a camera of some 50 frames a second."""

    def __init__(self) -> None:
        super().__init__(images_every=5)
        self.loop: dict[str, Any] = {"state": "open", "gain": 0.5, "opened_because": "diverged"}
        handlers = commands_of(self.engine) | {"loop": self._loop, "status": self._status}
        self.control = ControlServer(socket_path(self.name), handlers, lengthy=LENGTHY)
        self._stopping = threading.Event()
        self._camera = threading.Thread(target=self._expose, daemon=True)
        self._camera.start()

    def _status(self, fields: dict[str, Any]) -> dict[str, Any]:
        return {**self.engine.status(), "loop": self.loop}

    def _loop(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Stands for the engine's loop."""
        if fields["action"] == "gain":
            self.loop["gain"] = number_between("gain", fields["gain"], 0, 2)
        else:
            self.loop |= {
                "state": {"open": "open", "close": "closed"}[fields["action"]],
                "opened_because": None,
            }
        return {"loop": self.loop}

    def _expose(self) -> None:
        frames = simulated(20)
        with self.ring() as ring:
            number = 0
            while not self._stopping.wait(0.02):
                ring.publish(frames[number % len(frames)])
                number += 1

    def close(self) -> None:
        self._stopping.set()
        self._camera.join()
        self.control.close()
        super().close()


@contextmanager
def served(serve: Callable[..., None], *arguments: Any, **options: Any) -> Iterator[LiveServer]:
    """Serve in a thread."""
    stop, ready, found = threading.Event(), threading.Event(), []

    def note(server: LiveServer) -> None:
        found.append(server)
        ready.set()

    thread = threading.Thread(target=serve, args=(*arguments, stop, note), kwargs={"port": 0, **options})
    thread.start()
    try:
        assert ready.wait(30)
        yield found[0]
    finally:
        stop.set()
        thread.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_playwright() as driver:
        # Tests may run as root, in a container: Chromium's own sandbox is not there then.
        browser = driver.chromium.launch(executable_path=CHROMIUM, chromium_sandbox=os.geteuid() != 0)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def engine() -> Iterator[Running]:
    running = Running()
    yield running
    running.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def server(engine: Running, folder: Path) -> Iterator[LiveServer]:
    with served(serve, engine.name, folder=folder) as server:
        yield server


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open a page; whatever its console, its scripts or its requests say against it fails the test."""
    faults: list[str] = []

    with ExitStack() as contexts:

        def opened(url: str, *, drawn: bool = True, **options: Any) -> Any:
            context = contexts.enter_context(browser.new_context(**({"viewport": DESKTOP} | options)))
            page = context.new_page()
            page.set_default_timeout(PATIENCE_MS)
            page.on("console", lambda message: faults.append(f"{message.type}: {message.text}"))
            page.on("pageerror", lambda error: faults.append(str(error)))
            home = url.partition("#")[0]
            page.on("request", lambda made: faults.extend([] if made.url.startswith(home) else [made.url]))
            page.goto(url)
            if drawn:
                until(page, "document.documentElement.dataset.frames > 0")
            return page

        yield opened
    assert not faults


def until(page: Any, condition: str) -> None:
    """Wait for a condition; the page's own policy forbids the driver to do so in the page."""
    end = time.monotonic() + PATIENCE_MS / 1000
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(20)


def drawn(page: Any, canvas: str) -> int:
    """How many colours a canvas has."""
    return int(
        page.evaluate(
            """(id) => { const c = document.getElementById(id);
            const { data } = c.getContext("2d").getImageData(0, 0, c.width, c.height);
            return new Set(new Uint32Array(data.buffer)).size; }""",
            canvas,
        )
    )


def test_everything_is_drawn_and_goes_on(open_page: Any, server: LiveServer) -> None:
    page = open_page(server.url)
    assert page.locator("#state").inner_text() in ("● live", "live")
    until(page, "document.getElementById('raw-caption').textContent !== ''")
    until(page, "document.getElementById('histogram-caption').textContent !== ''")
    for canvas in ("raw", "denoised", "slopes", "flux", "valid", "latency", "histogram", "rms", "mean-flux"):
        assert drawn(page, canvas) > 2, canvas
    before = page.locator("#tiles dd").first.inner_text()
    until(page, f"document.querySelector('#tiles dd').textContent !== '{before}'")
    assert page.locator("#valid-caption").inner_text() == "16 of 16 valid"
    assert page.locator("#counters").inner_text().count("processed") == 1
    assert "#" not in page.url  # the token is not left in the address bar
    page.locator("#hold").click()
    page.wait_for_timeout(300)
    held = page.locator("#tiles dd").first.inner_text()
    page.wait_for_timeout(500)
    assert page.locator("#tiles dd").first.inner_text() == held


def test_settings_are_changed_and_errors_stand_beside_their_field(
    open_page: Any, server: LiveServer, engine: Running
) -> None:
    page = open_page(server.url)
    noise, kept = page.locator("#setting-noise_std"), page.locator("#setting-keep_brightest")
    assert noise.input_value() == "1"
    assert page.locator("#apply").is_disabled()
    noise.fill("-1")
    kept.fill("7")
    page.locator("#apply").click()
    error = page.locator("#setting-noise_std-error")
    error.filter(has_text="expected a number of at least 0").wait_for()
    assert noise.get_attribute("aria-invalid") == "true"
    assert kept.get_attribute("aria-invalid") is None
    assert engine.engine.live.settings.keep_brightest == 9  # all or nothing
    noise.fill("2.5")
    noise.press("Enter")
    page.locator("#settings-answer").filter(has_text="in effect from frame").wait_for()
    assert error.inner_text() == ""
    assert engine.engine.live.settings.noise_std == 2.5
    assert engine.engine.live.settings.keep_brightest == 7
    page.locator("#changes li").filter(has_text="noise_std = 2.5").wait_for()
    page.locator("#subapertures").fill("99")
    noise.fill("3")
    page.locator("#apply").click()
    page.locator("#subapertures-answer").filter(has_text="sub-aperture 99 does not exist").wait_for()
    page.locator("#undo").click()
    until(page, "document.getElementById('apply').disabled")


def test_loop_methods_and_recording(
    open_page: Any, server: LiveServer, engine: Running, folder: Path
) -> None:
    page = open_page(server.url)

    def enter(field: str, value: str) -> None:
        page.locator(field).fill(value)
        page.locator(field).press("Enter")

    def says(place: str, text: str) -> None:
        page.locator(place).filter(has_text=text).wait_for()

    says("#loop-state", "open: diverged")
    enter("#gain", "3")
    says("#loop-answer[data-ok=false]", "gain = 3: expected")
    enter("#gain", "0.3")
    says("#loop-answer", "open, gain 0.3")
    page.locator("#loop-close").click()
    says("#loop-state", "closed")
    assert engine.loop == {"state": "closed", "gain": 0.3, "opened_because": None}
    enter("#methods-text", "none,nothing")
    says("#interleave-answer[data-ok=false]", "'nothing': expected")
    page.locator("#methods-text").fill("none,tv")
    enter("#every", "5")
    says("#interleave-answer", "frame")
    page.locator("#methods tbody tr").nth(1).wait_for()
    assert page.locator("#methods tbody th").all_inner_texts() == ["none", "tv"]
    assert engine.engine.status()["methods"] == ["none", "tv"]
    enter("#file", "../night.zarr")
    says("#record-answer[data-ok=false]", "without a folder")
    page.locator("#file").fill("night.zarr")
    page.locator("#record").click()
    until(page, "!document.getElementById('stop-recording').disabled")
    page.wait_for_timeout(300)
    page.locator("#stop-recording").click()
    says("#record-answer", "stopped")
    assert len(read_telemetry(folder / "night.zarr").frame) > 0


@pytest.mark.parametrize("private", [False, True])
def test_without_the_token_one_may_only_watch(
    open_page: Any, engine: Running, tmp_path: Path, private: bool
) -> None:
    """Or not even that."""
    with served(serve, engine.name, folder=tmp_path, private=private) as server:
        page = open_page(server.url.partition("#")[0], drawn=not private)
        assert page.locator("#controls").is_hidden()
        if private:
            page.locator("#token-error").filter(has_text="needs the token").wait_for()
            assert page.locator("#tiles dd").count() == 0
        else:
            page.locator("#token").fill("guess")
            page.locator("#token").press("Enter")
            page.locator("#token-error").filter(has_text="wrong token").wait_for()
            assert page.locator("#controls").is_hidden()
        page.locator("#token").fill(server.access.token)
        page.locator("#token").press("Enter")
        page.locator("#setting-noise_std").wait_for()
        assert page.locator("#token-form").is_hidden()
        page.reload()
        page.locator("#setting-noise_std").wait_for()  # the tab remembers
        until(page, "document.getElementById('raw-caption').textContent !== ''")


def test_a_telephone_by_keyboard_and_every_control_has_a_name(open_page: Any, server: LiveServer) -> None:
    page = open_page(server.url, viewport=TELEPHONE, color_scheme="dark")
    page.locator("#setting-noise_std").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= TELEPHONE["width"]
    for control in page.locator("button:visible, input:visible, select:visible").all():
        box = control.bounding_box()
        assert 0 <= box["x"] <= TELEPHONE["width"] - box["width"]
    light = open_page(server.url)
    grounds = [each.evaluate("getComputedStyle(document.body).backgroundColor") for each in (page, light)]
    assert grounds[0] != grounds[1]
    page.locator("#setting-noise_std").wait_for()
    wanted = page.evaluate(
        """[...document.querySelectorAll("button, input, select")]
        .filter((each) => each.checkVisibility() && !each.disabled).length"""
    )
    reached = set()
    for _ in range(wanted + 5):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("[...document.querySelectorAll('*')].indexOf(document.activeElement)"))
    assert len(reached) >= wanted
    nameless = page.evaluate(
        """[...document.querySelectorAll("button, input, select, canvas")].filter((each) =>
        each.checkVisibility() && !(each.labels?.length || each.textContent.trim() || each.ariaLabel
        || each.getAttribute("aria-label") || each.closest(".legend"))).map((each) => each.outerHTML)"""
    )
    assert nameless == []
    page.locator("#hold").focus()
    page.keyboard.press("Space")
    assert page.locator("#hold").get_attribute("aria-pressed") == "true"
