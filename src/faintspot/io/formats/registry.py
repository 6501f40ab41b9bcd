"""List of the file formats; add new formats here."""

from __future__ import annotations

from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.base.files import check_regular
from faintspot.io.formats.csv_files import Csv
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.formats.fits_files import Fits, FitsGz
from faintspot.io.formats.hdf5_files import Hdf5, Matlab73
from faintspot.io.formats.image_files import Bmp, Jpeg, Png
from faintspot.io.formats.matlab_files import Matlab
from faintspot.io.formats.numpy_files import Npy, Npz
from faintspot.io.formats.tiff_files import Tiff
from faintspot.io.formats.zarr_files import Zarr

FORMATS: tuple[FileFormat, ...] = (
    Zarr(),
    Fits(),
    FitsGz(),
    Npy(),
    Npz(),
    Tiff(),
    Png(),
    Bmp(),
    Jpeg(),
    Hdf5(),
    Matlab73(),
    Matlab(),
    Csv(),
)
_SIGNATURE_BYTES = 8


def frame_format(path: Path) -> FileFormat:
    """Return the format of a file of frames, recognised by content.

    Raises
    ------
    InputError
        When it has no known format.
    OSError
        When it cannot be read.
    """
    start = b""
    if not path.is_dir():
        check_regular(path)
        with path.open("rb") as stream:
            start = stream.read(_SIGNATURE_BYTES)
        if not start:
            raise InputError(f"{path}: expected frames, the file is empty")
    for item in FORMATS:
        if item.has_frames(path, start):
            return item
    names = list(dict.fromkeys(item.name for item in FORMATS if item.signatures))
    raise InputError(f"{path}: expected a {_listed(names)} file or a Zarr store, it is none of them")


def slope_format(path: Path) -> FileFormat:
    """Return the format of a file of slopes, by the ending of its name.

    Raises
    ------
    InputError
        When the ending is unknown.
    """
    for item in FORMATS:
        if path.name.lower().endswith(item.endings):
            return item
    raise InputError(f"{path}: expected a name ending in {_listed(slope_endings())}")


def slope_endings() -> list[str]:
    """Return all endings of files of slopes."""
    return [ending for item in FORMATS for ending in item.endings]


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
