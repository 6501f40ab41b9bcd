"""Maps of wavefronts in files: CSV or FITS, by the ending of the name."""

from __future__ import annotations

import io
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import check_ending, write_atomically
from faintspot.base.report.figure_data import csv_text
from faintspot.io.optional_packages import load_fits
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.fit import Floats, Wavefront
from faintspot.slopes.wavefront.units import UNITS
from faintspot.slopes.wavefront.zonal import ZonalMap


def save_map(path: str | Path, wavefront: Wavefront, layout: Layout, zonal: ZonalMap | None = None) -> None:
    """Write the map of the mean wavefront to a file, replacing an existing one.

    Parameters
    ----------
    path : path
        .csv: a row for each point, with its x and y in the frame (px). .fits: an image for each quantity, in
        the frame's coordinates; with a zonal map also the table SUBAPERTURES.
    wavefront : Wavefront
        Values of the fitted modes, within their disk.
    layout : Layout
    zonal : ZonalMap, optional
        Adds its values, their standard errors (those of the sub-aperture around the point) and the number of
        the connected part.

    Raises
    ------
    InputError
        When the ending is unknown or the file cannot be written.
    MissingExtraError
        When astropy is needed and not installed.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import save_map
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5)
    >>> frame = np.random.default_rng(1).poisson(5.0, layout.frame_shape)
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frame)
    >>> save_map("map.csv", fs.fit_wavefront(slopes, layout, modes=5), layout)
    """
    path = Path(path)
    check_map_file(path)
    write_atomically(path, _WRITERS[path.suffix.lower()](wavefront, layout, zonal))


def check_map_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, *_WRITERS)


def _sheets(wavefront: Wavefront, zonal: ZonalMap | None) -> tuple[dict[str, Floats], Floats]:
    """Return the maps by name, and the points' distances from the centre of the pupil along an axis [px]."""
    reach = 1.0 if zonal is None else zonal.reach
    sheets = {"modes": wavefront.sheet(reach=reach)}
    if zonal is not None:
        known = zonal.nearest >= 0
        sheets["zonal"] = zonal.sheet
        sheets["standard_error"] = np.where(known, zonal.standard_errors[zonal.nearest], np.nan)
        sheets["part"] = np.where(known, zonal.parts[zonal.nearest], np.nan)
    return sheets, np.linspace(-reach, reach, len(sheets["modes"])) * wavefront.pupil.radius_px


def _csv(wavefront: Wavefront, _: Layout, zonal: ZonalMap | None) -> str:
    sheets, line = _sheets(wavefront, zonal)
    unit = wavefront.unit if wavefront.unit in UNITS else "px_subaperture"
    header = ["x_px", "y_px", *(name if name == "part" else f"{name}_{unit}" for name in sheets)]
    known = np.logical_or.reduce([np.isfinite(sheet) for sheet in sheets.values()])
    (x, y), (row, column) = wavefront.pupil.centre_px, np.nonzero(known)
    columns = [x + line[column], y + line[row], *(sheet[known] for sheet in sheets.values())]
    points = np.stack(columns, axis=1).tolist()
    return csv_text(header, [[f"{value:.7g}" if isfinite(value) else "" for value in row] for row in points])


def _fits(wavefront: Wavefront, layout: Layout, zonal: ZonalMap | None) -> bytes:
    fits = load_fits()
    unit = wavefront.unit if wavefront.unit in UNITS else "pixel"
    sheets, line = _sheets(wavefront, zonal)
    units: list[Any] = [fits.PrimaryHDU()]
    for name, sheet in sheets.items():
        image = fits.ImageHDU(sheet.astype(np.float32), name=name.upper())
        if name != "part":
            image.header["BUNIT"] = (unit, "times sub-apertures" if unit == "pixel" else "")
        for axis, centre in enumerate(wavefront.pupil.centre_px, start=1):
            image.header[f"CRPIX{axis}"] = 1.0
            image.header[f"CRVAL{axis}"] = (centre + line[0], "pixel of the frame, from 0")
            image.header[f"CDELT{axis}"] = line[1] - line[0]
        units.append(image)
    if zonal is not None:
        numbers = {"ROW": layout.cells[:, 0], "COLUMN": layout.cells[:, 1], "PART": zonal.parts}
        columns = [fits.Column(name, "J", array=values) for name, values in numbers.items()]
        places = {"X": layout.centres[:, 0], "Y": layout.centres[:, 1]}
        columns += [fits.Column(name, "D", "pixel", array=values) for name, values in places.items()]
        for name, values in (("ZONAL", zonal.values), ("STANDARD_ERROR", zonal.standard_errors)):
            columns.append(fits.Column(name, "D", unit, array=values))
        units.append(fits.BinTableHDU.from_columns(columns, name="SUBAPERTURES"))
    units[0].header["CREATOR"] = "faintspot"
    if wavefront.wavelength_nm is not None:
        units[0].header["WAVELEN"] = (wavefront.wavelength_nm, "length of a wave, nm")
    stream = io.BytesIO()
    fits.HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()


_Writer = Callable[[Wavefront, Layout, ZonalMap | None], str | bytes]
_WRITERS: dict[str, _Writer] = {".csv": _csv, ".fits": _fits}
