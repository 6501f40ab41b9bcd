"""Frames in, slopes out: FITS, NumPy, Zarr, CSV."""

from faintspot.io.frames import FrameSource, open_frames, read_array
from faintspot.io.slopes import create_writer, read_slopes
from faintspot.io.slopes_format import SlopeWriter, StoredSlopes

__all__ = [
    "FrameSource",
    "SlopeWriter",
    "StoredSlopes",
    "create_writer",
    "open_frames",
    "read_array",
    "read_slopes",
]
