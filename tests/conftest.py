"""Settings of Hypothesis, Ctrl-C, commands, and cheap pictures for the tests of pages.

Hypothesis draws the same examples in every run, and has no deadline, because the first call of a kernel
compiles it. `pytest --hypothesis-profile=thorough --hypothesis-seed=N` draws 40 times as many at random.
"""

import multiprocessing.process
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# So that python -O leaves no assertion of a test out.
HELPERS = [
    path for path in Path(__file__).parent.rglob("*.py") if not path.name.startswith(("conf", "test_"))
]
pytest.register_assert_rewrite(
    *(".".join(("tests", *path.relative_to(Path(__file__).parent).with_suffix("").parts)) for path in HELPERS)
)

from tests.patience import USUAL_EXAMPLES  # noqa: E402

settings.register_profile(
    "default",
    deadline=None,
    max_examples=USUAL_EXAMPLES,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("random", settings.get_profile("default"), derandomize=False, print_blob=True)
settings.register_profile("thorough", settings.get_profile("random"), max_examples=40 * USUAL_EXAMPLES)
settings.load_profile("default")

BASICS = ("test_public", "test_docstrings", "base/", "slopes/kernels/", "test_estimators.py")
"""What runs first, so that a broken import, kernel or estimator shows at once."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the basic tests before the others."""

    def rank(item: pytest.Item) -> int:
        name = item.nodeid.removeprefix("tests/")
        return next((number for number, start in enumerate(BASICS) if name.startswith(start)), len(BASICS))

    items.sort(key=rank)


# A shell's background job ignores Ctrl-C, and so would the programs that tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def no_processes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let only slow tests start processes."""
    if request.node.get_closest_marker("slow"):
        return

    def refuse(*arguments: object, **options: object) -> None:
        pytest.fail("a test that starts a process carries the marker `slow`")

    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", refuse)
    monkeypatch.setattr(subprocess.Popen, "__init__", refuse)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what runs commands in this process."""
    from tests.cli.cli_cases import Commands

    return Commands(capsys)


@pytest.fixture
def coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw without fine detail: pictures of reports take most of the time."""
    from faintspot.base.report import plots

    monkeypatch.setattr(plots, "DOTS_PER_INCH", 20)


@pytest.fixture
def undrawn_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures of pages empty, and draw none; take few draws of intervals: both have tests."""
    from matplotlib.figure import Figure

    from faintspot.base.checks import not_none
    from faintspot.base.report import page, plots
    from faintspot.slopes.wavefront.certificate import certify

    def empty(
        kind: Any, /, name: str, title: str, caption: str, rows: Any, height: float, **options: Any
    ) -> page.FigureWithData:
        figure = plots.new_figure(options.get("width", plots.WIDTH), height)
        return page.FigureWithData(name, title, caption, figure, plots.csv_of(rows))

    monkeypatch.setattr(page.FigureWithData, "of", classmethod(empty))
    monkeypatch.setitem(not_none(certify.__kwdefaults__), "draws", 400)
    monkeypatch.setattr(Figure, "savefig", lambda figure, *places, **options: None)
