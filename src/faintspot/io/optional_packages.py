"""Packages of the extra `io`, imported where they are used."""

from __future__ import annotations

from typing import Any

from faintspot.base.errors import MissingExtraError


def load_fits() -> Any:
    """Return the package astropy.io.fits; raise MissingExtraError when it is not installed."""
    try:
        from astropy.io import fits
    except ImportError:
        raise MissingExtraError("astropy", "io", "Reading or writing a FITS file") from None
    return fits


def load_hdf5() -> Any:
    """Return the package h5py; raise MissingExtraError when it is not installed."""
    try:
        import h5py
    except ImportError:
        raise MissingExtraError("h5py", "io", "Reading an HDF5 or MATLAB 7.3 file") from None
    return h5py


def load_pillow() -> Any:
    """Return the module PIL.Image; raise MissingExtraError when it is not installed."""
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("pillow", "io", "Reading a PNG file or a compressed TIFF file") from None
    return Image


def load_zarr() -> Any:
    """Return the package zarr; raise MissingExtraError when it is not installed."""
    try:
        import zarr
    except ImportError:
        raise MissingExtraError("zarr", "io", "Reading or writing a Zarr store") from None
    return zarr
