"""faintspot slopes with what is wrong: one line, exit code 2, nothing that looks like a result."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, Commands, assert_equal, expected, simulated

from faintspot.io import read_slopes

fits = pytest.importorskip("astropy.io.fits")
pytest.importorskip("zarr")


def half_of_a_compressed_file(path: Path) -> None:
    fits.PrimaryHDU(simulated()).writeto(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


# Those of the readers of frames and of the configuration have their own tests; here is one of each kind.
BAD_FRAMES: list[tuple[str, Callable[[Path], Any], tuple[str, ...]]] = [
    ("missing.fits", lambda path: None, ("no such file",)),
    ("*.fits", lambda path: None, ("no such file",)),
    ("text.fits", lambda path: path.write_text("x, y\n1, 2\n"), ("FITS",)),
    ("half.fits.gz", half_of_a_compressed_file, ("frames", "damaged or incomplete")),
    ("large.npy", lambda path: np.save(path, np.ones((3, 33, 32))), ("33 x 32", "32 x 32", "faintspot.toml")),
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


@pytest.mark.parametrize(
    ("text", "naming"),
    [
        ("not toml at all", ("not a TOML file", "line 1")),
        ("[estimator]\nname = 'tv'\nnoise_std = 2.0", ("[layout]", "estimator")),
        (CONFIGURATION.replace("= 10", "= 64"), ("keep_brightest", "64", "63")),
        (CONFIGURATION + '[calibration]\ndark = "dark.fits"', ("calibration.dark", "no such file")),
    ],
)
def test_bad_configuration(folder: Path, run: Commands, text: str, naming: tuple[str, ...]) -> None:
    np.save("a.npy", simulated())
    (folder / "faintspot.toml").write_text(text)
    run.refused("slopes", "a.npy", naming=("faintspot.toml", *naming))
    assert not (folder / "slopes.zarr").exists()


def test_no_configuration(folder: Path, run: Commands) -> None:
    np.save("a.npy", simulated())
    run.refused("slopes", "a.npy", "-c", "nix.toml", naming=("nix.toml", "no such file", "faintspot layout"))


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


@pytest.mark.parametrize("reference", [np.ones((16, 3)), np.full((16, 2), np.nan)])
def test_bad_reference(folder: Path, run: Commands, reference: Any) -> None:
    np.save("a.npy", simulated())
    np.save("r.npy", reference)
    run.refused("slopes", "a.npy", "--reference", "r.npy", naming=("r.npy", "reference"))
    run.refused("slopes", "a.npy", "--reference", "nix.npy", naming=("nix.npy", "no such file"))
