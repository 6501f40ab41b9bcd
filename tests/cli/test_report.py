"""faintspot report: the command; the page itself is tested with its own room."""

from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands, simulated

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("zarr")


@pytest.fixture
def measured(folder: Path, run: Commands) -> Path:
    np.save("a.npy", simulated())
    run.ok("slopes", "a.npy")
    run.ok("slopes", "a.npy", "-o", "plain.npz", "--no-denoise")
    return folder


def is_page(path: Path) -> bool:
    text = path.read_text(encoding="utf-8")
    return text.lstrip().lower().startswith("<!doctype html>") and text.rstrip().endswith("</html>")


@pytest.mark.slow
def test_one_and_two_methods(measured: Path, run: Commands) -> None:
    result = run.ok("report", "slopes.zarr/")  # as a shell completes it
    assert result.out == "slopes.html: open it in a browser\n"
    assert result.err == ""
    assert is_page(measured / "slopes.html")
    run.ok("report", "slopes.zarr", "plain.npz", "-o", "both.html")
    assert is_page(measured / "both.html")
    assert "plain.npz" in (measured / "both.html").read_text(encoding="utf-8")
    (measured / "a.npy").rename(measured / "b.npy")
    run.ok("report", "slopes.zarr", "-o", "with.html", "--recording", "b.npy")
    assert is_page(measured / "with.html")
