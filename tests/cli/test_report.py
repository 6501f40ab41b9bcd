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


def test_what_cannot_be_reported(measured: Path, run: Commands) -> None:
    (measured / "text.npz").write_text("nothing")
    np.savez("frames.npz", frames=simulated())
    (measured / "empty.zarr").mkdir()
    before = (measured / "plain.npz").read_bytes()
    for arguments, naming in {
        "nix.zarr": ("nix.zarr", "no such file"),
        "a.npy": ("a.npy",),
        ".": (".: ", "Zarr store of slopes"),
        "slopes.zarr plain.npz plain.npz": ("one file or two", "3"),
        "text.npz": ("text.npz", "slopes"),
        "frames.npz": ("frames.npz", "slopes"),
        "empty.zarr": ("empty.zarr",),
        "slopes.zarr --recording nix.npy": ("nix.npy",),
        "slopes.zarr -o nix/page.html": ("nix/page.html", "does not exist"),
        "plain.npz -o plain.npz": ("plain.npz", "page"),
    }.items():
        run.refused("report", *arguments.split(), naming=naming)
    assert not list(measured.glob("*.html"))
    assert (measured / "plain.npz").read_bytes() == before
