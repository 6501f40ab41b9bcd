"""Arrays in text files, as every option that takes an array reads them."""

from pathlib import Path

import numpy as np
import pytest

from faintspot.io import read_array

POKE = np.random.default_rng(3).standard_normal((14, 5))


@pytest.mark.parametrize("separator", [",", ";", " ", "\t"])
@pytest.mark.parametrize("ending", ["txt", "csv", "dat", "TXT"])
def test_text_files_have_any_separator(tmp_path: Path, separator: str, ending: str) -> None:
    path = tmp_path / f"poke.{ending}"
    np.savetxt(path, POKE, delimiter=separator, header="poke matrix", fmt="%.17g")
    np.testing.assert_array_equal(read_array(path), POKE)


def test_names_comments_and_empty_fields(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\ufeffx,y,z\n# by hand\n1,,3\n\n4,5,nan  # last\n")
    np.testing.assert_array_equal(read_array(path), [[1, np.nan, 3], [4, 5, np.nan]])
    path.write_text("\ufeff1 2\n")
    np.testing.assert_array_equal(read_array(path), [[1, 2]])
