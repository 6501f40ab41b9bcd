"""Interface of a file format, and contents of a file of slopes with what all writers share."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import check_shape
from faintspot.base.errors import InputError
from faintspot.base.files import check_bytes, memory_bytes
from faintspot.base.flags import VARIABLES
from faintspot.base.text_files import plain_values
from faintspot.io.stored_array import StoredArray

REQUIRED = frozenset(name for name, variable in VARIABLES.items() if variable.if_absent is None)

RESERVED_ATTRIBUTES = frozenset({"n_frames", "n_subapertures", "finished_frames", "complete", "coordinates"})

UNITS = ("px", "arcsec")
"""Units of positions, in files and for reading."""

COORDINATE_UNITS: Mapping[str, str] = {"centre_x": "px", "centre_y": "px"}


@dataclass(frozen=True)
class StoredSlopes:
    """Slopes read from a file.

    Attributes
    ----------
    variables : mapping
        x, y (px, or as attributes["unit"] says), flux (e-), valid, flags, iterations, bad_pixels,
        standard_error_x, standard_error_y (as x), covariance_xy (its square), each
        (n_finished, n_subapertures).
    coordinates : mapping
        Values per sub-aperture (n_subapertures,), such as centre_x and centre_y (px in the frame).
    attributes : mapping
        Attributes given to the writer: configuration, sources, fingerprint; a .csv file has none.
    complete : bool
        Whether all frames of the run are present.
    n_finished : int
        Number of frames present.
    """

    variables: Mapping[str, NDArray[Any]]
    coordinates: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any]
    complete: bool
    n_finished: int


def most_slopes_bytes() -> int:
    """Return the largest size of slopes read from a file: half of the machine's memory."""
    return memory_bytes() // 2


def check_stated(path: Path, shapes: Mapping[str, tuple[int, ...]], n_frames: int | None = None) -> None:
    """Refuse slopes whose file states shapes that do not fit together or need too much memory.

    Parameters
    ----------
    path : Path
        File, for messages.
    shapes : mapping
        Shapes of variables and coordinates.
    n_frames : int, optional
        Number of frames to read. Default: all.
    """
    shape = shapes.get("x", ())
    if len(shape) != 2:
        raise InputError(f"{path}: expected slopes x of shape (frames, sub-apertures), got {shape}")
    for name, other in shapes.items():
        expected = shape if name in VARIABLES else shape[1:]
        if other != expected:
            raise InputError(f"{path}: {name}: expected shape {expected}, got {other}")
    if n_frames is not None and not 0 <= n_frames <= shape[0]:
        raise InputError(f"{path}: expected up to {shape[0]} finished frames, got {n_frames}")
    check_memory(path, shape[0] if n_frames is None else n_frames, shape[1])


def check_memory(path: Path, n_frames: int, n_subapertures: int) -> None:
    """Raise InputError for slopes that need too much memory as a whole."""
    slope_bytes = sum(np.dtype(variable.dtype).itemsize for variable in VARIABLES.values())
    check_bytes(path, n_frames * n_subapertures * slope_bytes, most_slopes_bytes(), "slopes")


def unit_of(name: str, attributes: Mapping[str, object]) -> str:
    """Return the unit of a variable in a file with these attributes."""
    return VARIABLES[name].units.replace("px", str(attributes.get("unit", "px")))


def pixels_in(unit: str, attributes: Mapping[str, Any]) -> float:
    """Return the size of a pixel in a unit of positions; raise InputError if the pixel scale is not known."""
    if unit == "px":
        return 1.0
    scale = attributes.get("pixel_scale_arcsec")
    if scale is None:
        raise InputError(
            "unit = 'arcsec': expected slopes whose layout has pixel_scale_arcsec "
            "(faintspot layout --pixel-scale-arcsec)"
        )
    return float(scale)


@dataclass(frozen=True)
class RecordingHeader:
    """Description of an output: sizes, attributes (JSON values with a fingerprint) and coordinates."""

    n_frames: int
    n_subapertures: int
    attributes: Mapping[str, Any]
    coordinates: Mapping[str, NDArray[Any]]

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of frames and sub-apertures."""
        return self.n_frames, self.n_subapertures

    @property
    def fingerprint(self) -> str:
        """Identifier that runs share if one may continue the other's output."""
        return str(self.attributes["fingerprint"])


@dataclass(frozen=True)
class ExistingOutput:
    """Description of an existing output."""

    fingerprint: str | None
    """Fingerprint of the run; None if the format does not store it."""
    sizes: tuple[int, int]
    complete: bool

    def may_be_continued(self, path: Path, run: RecordingHeader, *, overwrite: bool) -> bool:
        """Return whether `run` continues the output (True) or replaces it (False).

        Raises
        ------
        InputError
            When it may do neither; the message names `path`.
        """
        is_same = self.fingerprint == run.fingerprint and self.sizes == run.sizes
        if is_same and not (overwrite and self.complete):
            return True
        if overwrite:
            return False
        if self.fingerprint is None:
            raise InputError(f"{path}: already exists; choose another name or --overwrite")
        raise InputError(
            f"{path}: belongs to another run (other frames or configuration); "
            "choose another name or --overwrite"
        )


def checked_block(
    run: RecordingHeader, finished: int, start: int, block: Mapping[str, Any]
) -> dict[str, NDArray[Any]]:
    """Return the block's variables in the file's types, after checking them."""
    if start != finished:
        raise InputError(f"slopes: expected the block that starts at frame {finished}, got frame {start}")
    if set(block) - set(VARIABLES) or REQUIRED - set(block):
        raise InputError(f"slopes: expected {', '.join(VARIABLES)}, got {', '.join(block)}")
    n = len(np.atleast_1d(block["x"]))
    if not 0 < n <= run.n_frames - finished:
        raise InputError(f"slopes: expected 1 to {run.n_frames - finished} more frames, got {n}")
    arrays = {}
    for name, values in with_absent(block).items():
        array = np.asarray(values)
        check_shape(f"slopes: {name}", array, (n, run.n_subapertures))
        arrays[name] = array.astype(VARIABLES[name].dtype, copy=False)
    return arrays


def with_absent(variables: Mapping[str, Any]) -> dict[str, Any]:
    """Return all variables in order, with defaults; raise KeyError when a required one is missing."""
    return {
        name: np.full(np.shape(variables["x"]), variable.if_absent, variable.dtype)
        if name not in variables and variable.if_absent is not None
        else variables[name]
        for name, variable in VARIABLES.items()
    }


def json_values(attributes: Mapping[str, object]) -> dict[str, Any]:
    """Return attributes as plain JSON values: NumPy numbers, arrays and paths are converted."""
    try:
        values: dict[str, Any] = plain_values(attributes, exact=True)
    except (TypeError, ValueError) as error:
        raise InputError(f"attributes: expected numbers, texts and lists of them ({error})") from None
    return values


class FileFormat:
    """A file format, implemented by a subclass in its own file and listed in `faintspot.io.frames`.

    All programs load all formats, so a format imports its optional packages where it uses them.
    """

    kinds: ClassVar[list[type["FileFormat"]]] = []
    """All formats, in the order of their definition; those whose name begins with _ are bases of others."""
    name: str
    """Name for messages."""
    signatures: tuple[bytes, ...] = ()
    """First bytes of a file of frames, up to 8; empty if frames are not supported."""
    endings: tuple[str, ...] = ()
    """Endings of files of slopes; empty if slopes are not supported."""

    def __init_subclass__(cls) -> None:
        if not cls.__name__.startswith("_"):
            FileFormat.kinds.append(cls)

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
