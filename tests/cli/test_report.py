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


@pytest.mark.slow
def test_frames_that_have_moved(measured: Path, run: Commands) -> None:
    (measured / "a.npy").rename(measured / "b.npy")
    run.ok("report", "slopes.zarr", "-o", "with.html", "--recording", "b.npy")
    assert is_page(measured / "with.html")
    run.refused("report", "slopes.zarr", "--recording", "nix.npy", naming=("nix.npy",))


def test_stores_that_hold_no_slopes_are_refused(measured: Path, run: Commands) -> None:
    run.refused("report", "nix.zarr", naming=("nix.zarr", "no such file"))
    run.refused("report", "a.npy", naming=("a.npy",))
    run.refused("report", ".", naming=(".: ", "Zarr store of slopes"))
    run.refused("report", "slopes.zarr", "plain.npz", "plain.npz", naming=("one file or two", "3"))
    (measured / "text.npz").write_text("nothing")
    run.refused("report", "text.npz", naming=("text.npz", "slopes"))
    np.savez("frames.npz", frames=simulated())
    run.refused("report", "frames.npz", naming=("frames.npz", "slopes"))
    (measured / "empty.zarr").mkdir()
    run.refused("report", "empty.zarr", naming=("empty.zarr",))
    assert not list(measured.glob("*.html"))


def test_pages_in_place_of_other_files_are_refused(measured: Path, run: Commands) -> None:
    run.refused("report", "slopes.zarr", "-o", "nix/page.html", naming=("nix/page.html", "does not exist"))
    before = (measured / "plain.npz").read_bytes()
    run.refused("report", "plain.npz", "-o", "plain.npz", naming=("plain.npz", "page"))
    assert (measured / "plain.npz").read_bytes() == before
