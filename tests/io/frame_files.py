"""Files of frames in every format."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from faintspot.io import open_frames

fits = pytest.importorskip("astropy.io.fits")
h5py: Any = pytest.importorskip("h5py")
tifffile = pytest.importorskip("tifffile")
zarr = pytest.importorskip("zarr")


@dataclass(frozen=True)
class FrameFile:
    """A kind of file with frames."""

    ending: str
    save: Callable[[Path, NDArray[Any]], object]
    """Writes frames (n, height, width) or one frame (height, width)."""
    key: str = ""
    """Name that selects the frames; empty if a file holds one unnamed array."""
    package: str = ""
    """Optional package that reads it, as a name in `sys.modules`."""
    whole: bool = False
    """Whether the frames are read whole."""
    checksum: bool = False
    """Whether a checksum covers the frames."""


def _npy(path: Path, frames: NDArray[Any]) -> None:
    np.save(path, frames)


def _npz(path: Path, frames: NDArray[Any]) -> None:
    np.savez(path, frames)


def _fits(path: Path, frames: NDArray[Any]) -> None:
    fits.PrimaryHDU(frames).writeto(path)


def _tiles(path: Path, frames: NDArray[Any]) -> None:
    lossless = {} if frames.dtype.kind != "f" else {"compression_type": "GZIP_1", "quantize_level": 0}
    fits.CompImageHDU(frames, tile_shape=(1,) * (frames.ndim - 2) + frames.shape[-2:], **lossless).writeto(
        path
    )


def _array(path: Path, frames: NDArray[Any], zarr_format: int) -> None:
    zarr.create_array(str(path), data=frames, chunks=(4, *frames.shape[1:]), zarr_format=zarr_format)


def _group(path: Path, frames: NDArray[Any]) -> None:
    group = zarr.create_group(str(path))
    group.create_array("frames", data=frames, chunks=(4, *frames.shape[1:]))
    group.create_array("dark", data=frames[0])


def _tiff(path: Path, frames: NDArray[Any], **options: Any) -> None:
    tifffile.imwrite(path, frames, photometric="minisblack", **options)


def _imagej(path: Path, frames: NDArray[Any]) -> None:
    _tiff(path, frames, imagej=frames.dtype in (np.uint8, np.uint16, np.float32))  # it knows no other types


def _pages(path: Path, frames: NDArray[Any]) -> None:
    with tifffile.TiffWriter(path) as writer:
        for page in frames.reshape(-1, *frames.shape[-2:]):
            writer.write(page, contiguous=False, metadata=None)


def _hdf5(path: Path, frames: NDArray[Any], **options: Any) -> None:
    with h5py.File(path, "w") as file:
        chunks = (1, *frames.shape[1:]) if options else None
        file.create_dataset("detector/frames", data=frames, chunks=chunks, **options)


def _matlab(path: Path, frames: NDArray[Any], compressed: bool) -> None:
    variables = {"frames": np.moveaxis(frames, 0, -1) if frames.ndim == 3 else frames, "gain": 2.0}
    scipy.io.savemat(path, variables, do_compression=compressed)


def _matlab73(path: Path, frames: NDArray[Any]) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file["frames"], file["dark"] = frames.swapaxes(-1, -2), frames[0].T
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")


_KINDS = (
    FrameFile("npy", _npy),
    FrameFile("fortran.npy", lambda path, frames: _npy(path, np.asfortranarray(frames))),
    FrameFile("npz", _npz, "arr_0", checksum=True),
    FrameFile(
        "deflated.npz",
        lambda path, frames: np.savez_compressed(path, frames=frames, dark=frames[0]),
        "frames",
        checksum=True,
    ),
    FrameFile("fits", _fits, "0", "astropy.io.fits"),
    FrameFile("n1.fits", lambda path, frames: _fits(path, frames[..., None, :, :]), "0", "astropy.io.fits"),
    FrameFile("1n.fits", lambda path, frames: _fits(path, frames[None, None]), "0", "astropy.io.fits"),
    FrameFile("1n.fits.fz", lambda path, frames: _tiles(path, frames[None]), "1", "astropy.io.fits"),
    FrameFile("n1.h5", lambda path, frames: _hdf5(path, frames[..., None, :, :]), "detector/frames", "h5py"),
    FrameFile("fits.gz", _fits, "primary", "astropy.io.fits", checksum=True),
    FrameFile("fits.fz", _tiles, "1", "astropy.io.fits"),
    FrameFile("v2.zarr", partial(_array, zarr_format=2), package="zarr"),
    FrameFile("v3.zarr", partial(_array, zarr_format=3), package="zarr"),
    FrameFile("group.zarr", _group, "frames", "zarr"),
    FrameFile("stack.tif", _tiff, "0", "tifffile"),
    FrameFile("pages.tif", _pages, package="tifffile"),
    FrameFile("deflated.tif", partial(_tiff, compression="zlib"), "0", "tifffile"),
    FrameFile("imagej.tif", _imagej, "0", "tifffile"),
    FrameFile("h5", _hdf5, "detector/frames", "h5py"),
    FrameFile("gzip.h5", partial(_hdf5, compression="gzip"), "/detector/frames", "h5py"),
    FrameFile("7.3.mat", _matlab73, "frames", "h5py"),
    FrameFile("mat", partial(_matlab, compressed=False), "frames", whole=True),
    FrameFile("deflated.mat", partial(_matlab, compressed=True), "frames", whole=True),
)
FRAME_FILES = {kind.ending: kind for kind in _KINDS}


def cube(n: int = 11, height: int = 6, width: int = 8, dtype: str = "int16") -> NDArray[Any]:
    return np.random.default_rng(5).integers(-900, 900, (n, height, width)).astype(dtype)


def assert_frames(location: str | Path, frames: NDArray[Any], **options: Any) -> str:
    """Expect these frames, whole and in part, in the machine's order of bytes; return what is noted."""
    with open_frames([location], **options) as source:
        assert (source.n_frames, *source.shape) == frames.shape
        assert source.dtype == frames.dtype.newbyteorder("=")
        for start in {0, len(frames) // 2}:
            np.testing.assert_array_equal(source.block(start, len(frames)), frames[start:])
        return source.note


def save(path: Path, frames: NDArray[Any]) -> Path:
    """Write frames in the format that the name states."""
    ending = max((ending for ending in FRAME_FILES if path.name.endswith(ending)), key=len)
    FRAME_FILES[ending].save(path, frames)
    return path
