"""Packages of the extra `io`, imported where they are used; a MissingExtraError names one that is missing."""

from __future__ import annotations

import importlib.util
from typing import Any

from faintspot.base.errors import MissingExtraError


def load_filelock() -> Any:
    """Return the package filelock."""
    return _load("filelock", "filelock", "Writing slopes that can be resumed")


def load_fits() -> Any:
    """Return the package astropy.io.fits."""
    return _load("astropy.io.fits", "astropy", "Reading or writing a FITS file")


def load_hdf5() -> Any:
    """Return the package h5py."""
    return _load("h5py", "h5py", "Reading an HDF5 or MATLAB 7.3 file")


def load_pillow() -> Any:
    """Return the module PIL.Image."""
    return _load("PIL.Image", "pillow", "Reading a PNG, BMP, JPEG or compressed TIFF file")


def load_tifffile() -> Any:
    """Return the package tifffile."""
    return _load("tifffile", "tifffile", "Reading a TIFF file")


def load_zarr() -> Any:
    """Return the package zarr."""
    return _load("zarr", "zarr", "Reading or writing a Zarr store")


def has_zarr() -> bool:
    """Return whether zarr is installed."""
    try:
        return importlib.util.find_spec("zarr") is not None
    except ImportError:  # an import hook that refuses it
        return False


def _load(module: str, package: str, purpose: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingExtraError(package, "io", purpose) from None
