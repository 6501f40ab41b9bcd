"""The progress bar on standard error, in a terminal, in a file and in a notebook."""

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, Self

import pytest

from faintspot.cli.output import progress_bar


class Output:
    """The widget that holds a bar, as ipywidgets has it."""

    def clear_output(self, wait: bool) -> None:
        """Forget what is shown."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Be in a notebook, without ipywidgets; return what it has been asked to display."""
    displayed: list[Any] = []
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    kernel = ModuleType("IPython.display")
    vars(kernel)["display"] = displayed.append
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", kernel)
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    return displayed


def count_to(total: int) -> None:
    with progress_bar("counting", "steps") as advance:
        for finished in range(total):
            advance(finished + 1, total)


def test_where_nobody_watches_it_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    count_to(4)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("counting")
    assert "4/4" in lines[0]


def test_a_bar_that_never_moved_leaves_no_trace(capsys: pytest.CaptureFixture[str]) -> None:
    count_to(0)
    assert capsys.readouterr() == ("", "")


def test_in_a_notebook_without_widgets(shown: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    count_to(4)
    assert "4/4" in capsys.readouterr().err
    assert shown == []


def test_in_a_notebook_it_moves(
    shown: list[Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    widgets = ModuleType("ipywidgets")
    widgets.__spec__ = ModuleSpec("ipywidgets", None)
    vars(widgets)["Output"] = Output
    monkeypatch.setitem(sys.modules, "ipywidgets", widgets)
    count_to(4)
    assert isinstance(shown[0], Output)
    texts = [item.text for item in shown[1:] if item.text]
    assert len(texts) > 1  # when it began, and at its end
    assert "0/?" in texts[0]
    assert "4/4" in texts[-1]
    assert capsys.readouterr() == ("", "")
