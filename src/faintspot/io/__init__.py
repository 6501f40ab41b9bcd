"""Input of frames, output of slopes and telemetry: FITS, TIFF, NumPy, Zarr, CSV, AOT."""

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes
from faintspot.io.frames import FrameSource, open_frames, read_array
from faintspot.io.slopes import create_writer, read_slopes
from faintspot.io.stored.slopes_format import StoredSlopes
from faintspot.io.stored.slopes_writer import SlopeWriter

if TYPE_CHECKING:
    from faintspot.io.telemetry.aot_reading import AotSensor as AotSensor
    from faintspot.io.telemetry.aot_reading import read_aot as read_aot
    from faintspot.io.telemetry.aot_writing import write_aot as write_aot
    from faintspot.io.telemetry.recording import Telemetry as Telemetry
    from faintspot.io.telemetry.recording import read_telemetry as read_telemetry

# Imported on first use because they need zarr.
_HOMES = {
    "AotSensor": "faintspot.io.telemetry.aot_reading",
    "read_aot": "faintspot.io.telemetry.aot_reading",
    "Telemetry": "faintspot.io.telemetry.recording",
    "read_telemetry": "faintspot.io.telemetry.recording",
    "write_aot": "faintspot.io.telemetry.aot_writing",
}

__all__ = [
    "AotSensor",
    "FrameSource",
    "SlopeWriter",
    "StoredSlopes",
    "Telemetry",
    "create_writer",
    "open_frames",
    "read_aot",
    "read_array",
    "read_slopes",
    "read_telemetry",
    "write_aot",
]

__getattr__ = lazy_attributes(__name__, _HOMES)
