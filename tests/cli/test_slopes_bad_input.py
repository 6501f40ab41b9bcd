"""faintspot slopes with what is wrong: one line, exit code 2, nothing that looks like a result."""

from __future__ import annotations

import errno
import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, Commands, assert_equal, expected, simulated

from faintspot.io import read_slopes, slopes_folder, zarr_store

fits = pytest.importorskip("astropy.io.fits")
pytest.importorskip("zarr")


def save_fits(path: Path) -> None:
    fits.PrimaryHDU(simulated()).writeto(path)


def truncated_fits(path: Path) -> None:
    save_fits(path)
    path.write_bytes(path.read_bytes()[:20_000])


def truncated_gzip(path: Path) -> None:
    save_fits(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def gzip_of_truncated(path: Path) -> None:
    save_fits(path.with_name("whole.fits"))
    path.write_bytes(gzip.compress(path.with_name("whole.fits").read_bytes()[:20_000]))


def saved(make: Callable[[], Any], **options: Any) -> Callable[[Path], None]:
    return lambda path: np.save(path, make(), **options)


BAD_FRAMES: list[tuple[str, Callable[[Path], Any], tuple[str, ...]]] = [
    ("missing.fits", lambda path: None, ("no such file",)),
    ("*.fits", lambda path: None, ("no such file",)),
    ("folder", lambda path: path.mkdir(), ("Zarr store or a file of frames", "directory")),
    ("empty.fits", lambda path: path.touch(), ("file is empty",)),
    ("truncated.fits", truncated_fits, ("truncated", "20000 bytes")),
    ("truncated.fits.gz", truncated_gzip, ("frame", "damaged or incomplete")),
    ("short.fits.gz", gzip_of_truncated, ("frame 8 (counted from 0)", "damaged or incomplete")),
    ("text.fits", lambda path: path.write_text("x, y\n1, 2\n"), ("FITS",)),
    ("header.fits", lambda path: path.write_text("SIMPLE but not FITS"), ("FITS",)),
    ("complex.npy", saved(lambda: np.ones((3, 32, 32), complex)), ("real numbers", "complex128")),
    ("text.npy", saved(lambda: np.full((3, 32, 32), "a")), ("real numbers", "<U1")),
    ("objects.npy", saved(lambda: np.full((3, 32, 32), None), allow_pickle=True), ("objects",)),
    ("large.npy", saved(lambda: np.ones((3, 33, 32))), ("33 x 32", "32 x 32", "faintspot.toml")),
    ("4d.npy", saved(lambda: np.ones((2, 3, 32, 32))), ("(frames, height, width)", "(2, 3, 32, 32)")),
    ("1d.npy", saved(lambda: np.ones(32)), ("(frames, height, width)", "(32,)")),
    ("none.npy", saved(lambda: np.ones((0, 32, 32))), ("at least one frame", "(0, 32, 32)")),
    ("cut.npz", lambda path: path.write_bytes(b"PK\x03\x04 and no more"), ("valid .npz file",)),
]


@pytest.mark.parametrize(("name", "make", "naming"), BAD_FRAMES, ids=[case[0] for case in BAD_FRAMES])
@pytest.mark.parametrize("output", ["s.zarr", "s.npz"])
def test_bad_frames(
    folder: Path, run: Commands, name: str, make: Any, naming: tuple[str, ...], output: str
) -> None:
    make(folder / name)
    run.refused("slopes", name, "-o", output, naming=(name, *naming))
    if output == "s.npz" or not name.endswith("fits.gz"):
        assert not (folder / output).exists()
    else:  # a compressed file is found to be damaged only on the way
        assert not read_slopes(folder / output).complete


CONFIGURATIONS: list[tuple[str, tuple[str, ...]]] = [
    ("not toml at all", ("not a TOML file", "line 1")),
    ("[estimator]\nname = 'tv'\nnoise_std = 2.0", ("[layout]", "estimator")),
    ("[layout.grid]\nshape = [4, 4]\npixels = 8", ("[estimator]", "layout")),
    (
        CONFIGURATION.replace("keep_brightest", "keep_brigthest"),
        ("keep_brigthest", "did you mean keep_bright"),
    ),
    (
        CONFIGURATION.replace("[estimator]", "[estimater]"),
        ("estimater", "unknown table", "did you mean estimator?"),
    ),
    (CONFIGURATION + "[telescope]\nd = 1", ("telescope", "unknown table", "known: layout")),
    (CONFIGURATION.replace("2.0", "-2.0"), ("estimator.noise_std", "-2", "at least 0")),
    (CONFIGURATION.replace("2.0", "nan"), ("estimator.noise_std", "finite", "NaN")),
    (CONFIGURATION.replace("2.0", "inf"), ("estimator.noise_std", "finite", "infinite")),
    (CONFIGURATION.replace("2.0", '"loud"'), ("estimator.noise_std", "number")),
    (CONFIGURATION.replace("2.0", "[1.0, 2.0]"), ("noise_std", "16", "2")),
    (CONFIGURATION.replace("= 10", "= 64"), ("keep_brightest", "64", "63")),
    (CONFIGURATION.replace("= 10", "= 2.5"), ("estimator.keep_brightest", "2.5", "whole number")),
    (CONFIGURATION.replace("pixels = 8", "pixels = 1"), ("layout.grid", "pixels", "1", "from 2 to 64")),
    (CONFIGURATION.replace("[4, 4]", '"4x4"'), ("layout.grid", "shape")),
    (
        CONFIGURATION.replace("pixels = 8", "pixels = 8\npixel = 8"),
        ("layout.grid.pixel", "did you mean pixels?"),
    ),
    (
        CONFIGURATION.replace("pixels = 8", "pixels = 8\nouter_radius = 0.1"),
        ("layout.grid", "no sub-aperture"),
    ),
    (
        CONFIGURATION.replace("pixels = 8", "pixels = 8\nframe_shape = [30, 32]"),
        ("layout", "leaves the frame", "30 x 32"),
    ),
    (CONFIGURATION.replace("pixels = 8", "pixels = 8\npitch = 6"), ("layout", "overlap")),
    (
        "[layout]\nframe_shape = [32, 32]\nwindow = [8, 8]\ncorners = []\n[estimator]\nname = 'tv'",
        ("layout.corners", "empty"),
    ),
    (CONFIGURATION + "[calibration]\ngain_e_per_adu = 0.0", ("calibration.gain_e_per_adu", "from 1e-09")),
    (CONFIGURATION + '[calibration]\ndark = "dark.fits"', ("calibration.dark", "dark.fits", "no such file")),
    ("estimator = 3\n[layout.grid]\nshape = [4, 4]\npixels = 8", ("estimator", "expected a table")),
]


@pytest.mark.parametrize(("text", "naming"), CONFIGURATIONS, ids=[str(i) for i in range(len(CONFIGURATIONS))])
def test_bad_configuration(folder: Path, run: Commands, text: str, naming: tuple[str, ...]) -> None:
    np.save("a.npy", simulated())
    (folder / "faintspot.toml").write_text(text)
    run.refused("slopes", "a.npy", naming=("faintspot.toml", *naming))
    assert not (folder / "slopes.zarr").exists()


def test_no_configuration(folder: Path, run: Commands) -> None:
    np.save("a.npy", simulated())
    run.refused("slopes", "a.npy", "-c", "nix.toml", naming=("nix.toml", "no such file", "faintspot layout"))
    run.refused("slopes", "a.npy", "-c", ".", naming=(".", "cannot be read", "directory"))
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00")
    run.refused("slopes", "a.npy", "-c", "binary.toml", naming=("binary.toml", "not a TOML file"))


def test_bad_output(folder: Path, run: Commands) -> None:
    np.save("a.npy", simulated())
    run.refused("slopes", "a.npy", "-o", "s.xyz", naming=("s.xyz", ".zarr", ".csv"))
    run.refused("slopes", "a.npy", "-o", "nix/s.npz", naming=("nix/s.npz", "folder nix does not exist"))
    run.refused("slopes", "a.npy", "-o", "a.npy/s.npz", naming=("a.npy", "does not exist"))
    run.refused("slopes", "a.npy", "-o", "", naming=("expected a name",))
    run.ok("slopes", "a.npy", "-o", "s.csv")
    run.refused("slopes", "a.npy", "-o", "s.csv", naming=("s.csv", "already exists", "--overwrite"))


@pytest.mark.parametrize("output", ["s.zarr", "s.npz", "s.fits"])
def test_output_of_another_run(folder: Path, run: Commands, output: str) -> None:
    np.save("a.npy", simulated())
    run.ok("slopes", "a.npy", "-o", output)
    run.refused("slopes", "a.npy", "-o", output, "--no-denoise", naming=(output, "another run"))
    assert_equal(folder / output, expected(simulated()))


@pytest.mark.parametrize("name", ["s.npz", "s.npz:frames"])
def test_frames_are_never_replaced_by_their_slopes(folder: Path, run: Commands, name: str) -> None:
    np.savez("s.npz", frames=simulated())
    before = (folder / "s.npz").read_bytes()
    run.refused("slopes", name, "-o", "s.npz", "--overwrite", naming=("s.npz", "frames"))
    assert (folder / "s.npz").read_bytes() == before


def test_foreign_directory_is_never_replaced(folder: Path, run: Commands) -> None:
    np.save("a.npy", simulated())
    (folder / "s.zarr").mkdir()
    (folder / "s.zarr" / "precious").touch()
    run.refused("slopes", "a.npy", "-o", "s.zarr", "--overwrite", naming=("s.zarr", "expected slopes"))
    assert (folder / "s.zarr" / "precious").exists()


@pytest.mark.parametrize("output", ["s.zarr", "s.npz", "s.csv"])
def test_full_disk(folder: Path, run: Commands, output: str, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save("a.npy", simulated())
    module = zarr_store if output.endswith("zarr") else slopes_folder

    def full(path: Path, text: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module, "replace_file", full)
        run.refused("slopes", "a.npy", "-o", output, naming=(output, "disk is full"))
    assert output.endswith("zarr") or not (folder / output).exists()
    run.ok("slopes", "a.npy", "-o", output)
    assert_equal(folder / output, expected(simulated()))


@pytest.mark.parametrize(
    "reference",
    [np.ones((16, 3)), np.ones(16), np.ones((3, 2)), np.full((16, 2), np.nan), np.ones((4, 4, 2))],
)
def test_bad_reference(folder: Path, run: Commands, reference: Any) -> None:
    np.save("a.npy", simulated())
    np.save("r.npy", reference)
    run.refused("slopes", "a.npy", "--reference", "r.npy", naming=("r.npy", "reference"))
    run.refused("slopes", "a.npy", "--reference", "nix.npy", naming=("nix.npy", "no such file"))


@pytest.mark.parametrize(
    ("arguments", "naming"),
    [
        ([], ("FRAMES", "--help")),
        (["a.npy", "--nix"], ("--nix",)),
        (["a.npy", "--threads", "0"], ("--threads", "0")),
        (["a.npy", "--block", "many"], ("--block", "many")),
    ],
)
def test_usage(folder: Path, run: Commands, arguments: list[str], naming: tuple[str, ...]) -> None:
    run.refused("slopes", *arguments, naming=naming)
