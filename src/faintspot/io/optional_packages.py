"""Packages of the extra `io`, imported where they are used."""

from __future__ import annotations

from typing import Any

from faintspot.errors import MissingExtraError


def load_fits() -> Any:
    """Return the package astropy.io.fits; MissingExtraError when it is not installed."""
    try:
        from astropy.io import fits
    except ImportError:
        raise MissingExtraError("astropy", "io", "Reading or writing a FITS file") from None
    return fits


def load_zarr() -> Any:
    """Return the package zarr; MissingExtraError when it is not installed."""
    try:
        import zarr
    except ImportError:
        raise MissingExtraError("zarr", "io", "Reading or writing a Zarr store") from None
    return zarr
