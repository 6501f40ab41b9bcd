"""Input of frames, output of slopes and telemetry: FITS, TIFF, NumPy, Zarr, CSV, AOT."""

from typing import TYPE_CHECKING

from faintspot.base.errors import lazy_names

if TYPE_CHECKING:
    from faintspot.io.aot_reading import AotSensor as AotSensor
    from faintspot.io.aot_reading import read_aot as read_aot
    from faintspot.io.aot_writing import write_aot as write_aot
    from faintspot.io.file_format import StoredSlopes as StoredSlopes
    from faintspot.io.frames import FrameSource as FrameSource
    from faintspot.io.frames import open_frames as open_frames
    from faintspot.io.frames import read_array as read_array
    from faintspot.io.slopes import create_writer as create_writer
    from faintspot.io.slopes import read_slopes as read_slopes
    from faintspot.io.slopes_writer import SlopeWriter as SlopeWriter
    from faintspot.io.telemetry import Telemetry as Telemetry
    from faintspot.io.telemetry import read_telemetry as read_telemetry

__getattr__, __dir__, __all__ = lazy_names(__name__)
