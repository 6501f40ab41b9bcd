"""What a file format is to faintspot: it holds frames to be read, slopes that are written, or both."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from faintspot.base.errors import InputError
from faintspot.io.locations import StoredArray
from faintspot.io.slopes_folder import FolderStorage, is_partial, partial_folder
from faintspot.io.slopes_format import RecordingHeader, StoredSlopes
from faintspot.io.slopes_writer import ExistingOutput, Storage


class FileFormat:
    """A file format: a subclass in a file of its own, with what it can do, named in `faintspot.io.formats`.

    All formats are known to every program, so a package that one needs is imported where it is used.
    """

    name: str
    """For messages."""
    signatures: tuple[bytes, ...] = ()
    """What a file of frames begins with, up to 8 bytes; none where frames are not read."""
    endings: tuple[str, ...] = ()
    """Names of files of slopes end with them; none where slopes are not written."""

    def has_frames(self, path: Path, start: bytes) -> bool:
        """Tell whether a path is of this format; `start` are the first bytes of a file, of a folder none."""
        return start.startswith(self.signatures)

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return an array of a file: the one named `key`, or by itself that of the frames."""
        raise NotImplementedError

    def require(self) -> None:
        """Raise MissingExtraError when a package for slopes is absent: before the work, not after."""

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write slopes to a file; the arrays may be mapped from the disk and larger than memory."""
        raise NotImplementedError

    def read(self, path: Path) -> StoredSlopes:
        """Read slopes; any usual exception when there are none, InputError when it knows the reason."""
        raise NotImplementedError

    def has_slopes(self, path: Path) -> bool:
        """Tell slopes from other arrays in a file whose name ends like one of slopes."""
        return True

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return what a finished output says of itself, or None when there is none."""
        if not path.exists():
            return None
        if not path.is_file():
            raise InputError(f"{path}: exists already and is no file: choose another name")
        stored = self.read(path)
        frames, subapertures = stored.variables["x"].shape
        return ExistingOutput(stored.attributes.get("fingerprint"), (frames, subapertures), complete=True)

    def leftovers(self, path: Path) -> bool:
        """Tell whether an unfinished output lies beside `path`."""
        return is_partial(partial_folder(path))

    def storage(self, path: Path, run: RecordingHeader) -> Storage:
        """Return where an unfinished output is kept."""
        return FolderStorage(path, run, self.write)
