from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.io.slope_files import ATTRIBUTES, begin, part, result, write

from faintspot.io.slopes import read_reference

fits = pytest.importorskip("astropy.io.fits")
zarr = pytest.importorskip("zarr")


def means() -> NDArray[np.float64]:
    """Mean of the valid slopes of each sub-aperture, one by one."""
    slopes = result()
    columns = [(slopes["valid"][:, i], i) for i in range(7)]
    return np.array([[slopes[name][column].mean(dtype=np.float64) for name in "xy"] for column in columns])


@pytest.mark.parametrize("shape", [(7, 2), (14,)])
def test_on_top_of_their_own_reference(tmp_path: Path, shape: tuple[int, ...]) -> None:
    reference = np.arange(14.0).reshape(7, 2) / 10
    stored = reference if shape == (7, 2) else reference.T.reshape(14)
    write(tmp_path / "a.npz", result(), attributes={**ATTRIBUTES, "reference": stored.tolist()})
    np.testing.assert_allclose(read_reference(tmp_path / "a.npz"), means() + reference, rtol=1e-12)


def test_where_nothing_is_valid(tmp_path: Path) -> None:
    slopes = result()
    slopes["valid"][:, 3] = False
    write(tmp_path / "a.npz", slopes)
    expected = means()
    expected[3] = np.median(np.delete(expected, 3, axis=0), axis=0)
    np.testing.assert_allclose(read_reference(tmp_path / "a.npz"), expected, rtol=1e-12)


def test_unfinished_store_gives_the_mean_so_far(tmp_path: Path) -> None:
    begin(tmp_path / "a.zarr", 20)
    slopes = part(result(), 0, 20)
    mean = slopes["x"][slopes["valid"][:, 0], 0].mean(dtype=np.float64)
    assert read_reference(tmp_path / "a.zarr")[0, 0] == pytest.approx(mean, rel=1e-12)


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.npz:one", "a.fits", "a.fits.gz", "a.zarr"])
def test_arrays_are_read_from_every_format(tmp_path: Path, name: str) -> None:
    array = np.random.default_rng(2).normal(size=(7, 2))
    path = tmp_path / name.partition(":")[0]
    if ".fits" in name:
        fits.PrimaryHDU(array).writeto(path)
    elif "zarr" in name:
        zarr.create_array(str(path), data=array)
    elif "npz" in name:
        np.savez(path, one=array, frames=array)
    else:
        np.save(path, array)
    np.testing.assert_array_equal(read_reference(tmp_path / name), array)
