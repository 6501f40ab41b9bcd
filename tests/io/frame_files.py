"""Files of frames in every format, for the tests of reading."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from numpy.typing import NDArray

from faintspot.base.errors import InputError

fits = pytest.importorskip("astropy.io.fits")
tifffile = pytest.importorskip("tifffile")
zarr = pytest.importorskip("zarr")

FORMATS = ["npy", "fortran.npy", "npz", "deflated.npz", "fits", "fits.gz", "fits.fz"]
FORMATS += ["v2.zarr", "v3.zarr", "group.zarr", "stack.tif", "pages.tif", "deflated.tif", "imagej.tif"]
FORMATS += ["mat", "deflated.mat"]
if importlib.util.find_spec("h5py") is not None:
    FORMATS += ["h5", "gzip.h5", "7.3.mat"]


def cube(n: int = 11, height: int = 6, width: int = 8, dtype: str = "int16") -> NDArray[Any]:
    return np.random.default_rng(5).integers(-900, 900, (n, height, width)).astype(dtype)


def save(path: Path, frames: NDArray[Any]) -> Path:
    """Write frames in the format that the name tells."""
    name = path.name
    if name.endswith("fortran.npy"):
        np.save(path, np.asfortranarray(frames))
    elif name.endswith("npy"):
        np.save(path, frames)
    elif name.endswith("deflated.npz"):
        np.savez_compressed(path, frames=frames, dark=frames[0])
    elif name.endswith("npz"):
        np.savez(path, frames)
    elif name.endswith("fz"):
        lossless = {} if frames.dtype.kind != "f" else {"compression_type": "GZIP_1", "quantize_level": 0}
        fits.CompImageHDU(frames, tile_shape=(1, *frames.shape[1:]), **lossless).writeto(path)
    elif "fits" in name:
        fits.PrimaryHDU(frames).writeto(path)
    elif name.endswith("pages.tif"):
        with tifffile.TiffWriter(path) as writer:
            for page in frames.reshape(-1, *frames.shape[-2:]):
                writer.write(page, contiguous=False, metadata=None)
    elif name.endswith(".tif"):
        options: dict[str, Any] = {"compression": "zlib"} if name.endswith("deflated.tif") else {}
        if name.endswith("imagej.tif") and frames.dtype in (np.uint8, np.uint16, np.float32):
            options = {"imagej": True}  # which knows no other types
        tifffile.imwrite(path, frames, photometric="minisblack", **options)
    elif name.endswith(".h5"):
        import h5py

        with h5py.File(path, "w") as file:
            options = {"chunks": (1, *frames.shape[1:]), "compression": "gzip"} if "gzip" in name else {}
            file.create_dataset("detector/frames", data=frames, **options)
    elif name.endswith("7.3.mat"):
        import h5py

        with h5py.File(path, "w", userblock_size=512) as file:
            file["frames"], file["dark"] = frames.swapaxes(-1, -2), frames[0].T
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    elif name.endswith(".mat"):
        variables = {"frames": np.moveaxis(frames, 0, -1) if frames.ndim == 3 else frames, "gain": 2.0}
        scipy.io.savemat(path, variables, do_compression="deflated" in name)
    elif "group" in name:
        group = zarr.create_group(str(path))
        group.create_array("frames", data=frames, chunks=(4, *frames.shape[1:]))
        group.create_array("dark", data=frames[0])
    else:
        zarr_format = 2 if "v2" in name else 3
        zarr.create_array(str(path), data=frames, chunks=(4, *frames.shape[1:]), zarr_format=zarr_format)
    return path


def assert_message(error: pytest.ExceptionInfo[InputError], *parts: str) -> None:
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message
