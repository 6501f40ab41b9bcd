"""Locations of arrays in files: "file", "file.npz:key", "file.fits:EXTNAME", "store.zarr:path"."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from faintspot.base.errors import InputError

PREFERRED_NAME = "frames"
_MOST_LISTED = 20


def split_location(location: str | Path) -> tuple[Path, str | None]:
    """Split "file:key" into file and key; the name of an existing file has no key.

    Raises
    ------
    InputError
        When there is no such file or directory.
    """
    whole = Path(location)
    if _exists(whole):
        return whole, None
    before, separator, key = str(location).rpartition(":")
    if separator and key and before and _exists(Path(before)):
        return Path(before), key
    raise InputError(f"{location}: no such file or directory")


def _exists(path: Path) -> bool:
    """Return whether the file exists; False for names that no file can have."""
    try:
        return path.exists()
    except (OSError, ValueError):  # name too long, or with characters that are not allowed
        return False


def choose_name(path: Path, dimensions: Mapping[str, int], key: str | None) -> str:
    """Return the name of the array to read: `key`, or "frames", or the only 2-D or 3-D one.

    Parameters
    ----------
    path : Path
        The file, for messages.
    dimensions : mapping
        Number of dimensions of every array in the file.
    key : str or None
        The requested name.

    Raises
    ------
    InputError
        When there is no such array, or several and none is requested.
    """
    listed = ", ".join(list(dimensions)[:_MOST_LISTED]) or "none"
    if len(dimensions) > _MOST_LISTED:
        listed += f" and {len(dimensions) - _MOST_LISTED} more"
    if key is not None:
        if key not in dimensions:
            raise InputError(f"{path}: no array {key!r}; it contains: {listed}")
        return key
    if PREFERRED_NAME in dimensions:
        return PREFERRED_NAME
    images = [name for name, count in dimensions.items() if count in (2, 3)]
    images = images or [name for name, count in dimensions.items() if count > 3]
    if len(images) != 1:
        raise InputError(
            f"{path}: expected one array of frames, or one named 'frames'; "
            f"it contains: {listed}; choose one with {path.name}:NAME"
        )
    return images[0]


def one_line(error: BaseException) -> str:
    """Return the message of another library's error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
