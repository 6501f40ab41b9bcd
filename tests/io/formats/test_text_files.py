"""Arrays in text files, as every option that takes an array reads them."""

from pathlib import Path

import numpy as np
import pytest
from tests.refusals import refused

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


@pytest.mark.parametrize(
    "content", [b"", b"\n# nothing\n", b"a,b\n", b"1 2\n3\n", b"1,x\n2,3\n", b"\xff\xfe1,2\n"]
)
def test_no_rows_of_numbers(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    with refused("a.txt"):
        read_array(path)
    if content:
        with refused("no name of an array"):
            read_array(f"{path}:matrix")
