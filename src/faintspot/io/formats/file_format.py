"""Interface of a file format, which holds frames to read, slopes to write, or both."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from faintspot.base.errors import InputError
from faintspot.io.slopes_format import ExistingOutput, StoredSlopes
from faintspot.io.stored_array import StoredArray


class FileFormat:
    """A file format, implemented by a subclass in its own file and listed in `faintspot.io.formats.registry`.

    All programs load all formats, so a format imports its optional packages where it uses them.
    """

    name: str
    """Name for messages."""
    signatures: tuple[bytes, ...] = ()
    """First bytes of a file of frames, up to 8; empty if frames are not supported."""
    endings: tuple[str, ...] = ()
    """Endings of files of slopes; empty if slopes are not supported."""

    def has_frames(self, path: Path, start: bytes) -> bool:
        """Return whether a path is of this format; `start` holds a file's first bytes (b"" for a folder)."""
        return start.startswith(self.signatures)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an array of a file: the one named `key`, by default that of the frames.

        Errors that are no InputError mean that the file is damaged.
        """
        raise NotImplementedError

    def names(self, path: Path) -> list[str]:
        """Return the names of the arrays of a file, by which layouts of telemetry are recognised."""
        return []

    def require(self) -> None:
        """Raise MissingExtraError when a package for slopes is missing; called before the work."""

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write slopes to a file.

        The variables may be larger than memory: they have a shape and a dtype, and slices of them are arrays.
        """
        raise NotImplementedError

    def read(self, path: Path) -> StoredSlopes:
        """Read slopes; raise InputError for a known fault, another exception if there are no slopes."""
        raise NotImplementedError

    def has_slopes(self, path: Path) -> bool:
        """Return whether a file with an ending for slopes holds slopes."""
        return True

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return the description of a finished output, or None when there is none."""
        if not path.exists():
            return None
        if not path.is_file():
            raise InputError(f"{path}: already exists and is not a file; choose another name")
        slopes = self.read(path)
        frames, subapertures = slopes.variables["x"].shape
        return ExistingOutput(slopes.attributes.get("fingerprint"), (frames, subapertures), complete=True)

    def store(self, path: Path) -> Path:
        """Return the Zarr store with the slopes of an unfinished run."""
        return path.with_name(f"{path.name}.partial.zarr")
