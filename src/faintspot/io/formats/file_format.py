"""Interface of a file format, which holds frames to read, slopes to write, or both."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from faintspot.base.errors import InputError
from faintspot.io.locations import StoredArray
from faintspot.io.stored.slopes_folder import FolderStorage, is_partial, partial_folder
from faintspot.io.stored.slopes_format import RecordingHeader, StoredSlopes
from faintspot.io.stored.slopes_writer import ExistingOutput, Storage


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
        """Return an array of a file: the one named `key`, by default that of the frames."""
        raise NotImplementedError

    def require(self) -> None:
        """Raise MissingExtraError when a package for slopes is missing; called before the work."""

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write slopes to a file; the arrays may be memory-mapped and larger than memory."""
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
        stored = self.read(path)
        frames, subapertures = stored.variables["x"].shape
        return ExistingOutput(stored.attributes.get("fingerprint"), (frames, subapertures), complete=True)

    def leftovers(self, path: Path) -> bool:
        """Return whether an unfinished output lies beside `path`."""
        return is_partial(partial_folder(path))

    def storage(self, path: Path, run: RecordingHeader) -> Storage:
        """Return the storage of an unfinished output."""
        return FolderStorage(path, run, self.write)
