"""Wavefronts and their maps in files: CSV, JSON or FITS, by the ending of the name."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import check_ending, write_atomically
from faintspot.base.json_text import to_json
from faintspot.base.report.figure_data import csv_text
from faintspot.io.optional_packages import load_fits
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.fit import Floats, Wavefront, total
from faintspot.slopes.wavefront.units import UNITS
from faintspot.slopes.wavefront.words import mode_records
from faintspot.slopes.wavefront.zonal import ZonalMap

_WAVEFRONT_ENDINGS, _MAP_ENDINGS = (".csv", ".json", ".fits"), (".csv", ".fits")
_FITS_FORMATS = {
    "noll": "J",
    "osa": "J",
    "name": "32A",
    "n": "J",
    "m": "J",
    "mean": "D",
    "standard_error": "D",
}


def save_wavefront(path: str | Path, wavefront: Wavefront) -> None:
    """Write a wavefront to a file, replacing an existing one.

    Parameters
    ----------
    path : path
        .csv: a row for the mean and one for each frame, with rms, coefficients and standard errors. .json:
        the same by name, and the modes. .fits: the map of the mean wavefront, the table MODES, and the images
        COEFFICIENTS and STANDARD_ERRORS (a row for each frame). A frame that could not be fitted is empty,
        null or NaN.
    wavefront : Wavefront

    Raises
    ------
    InputError
        When the ending is unknown or the file cannot be written.
    MissingExtraError
        When astropy is needed and not installed.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import save_wavefront
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 5, flux_e=1000.0,
    ...     positions=np.tile([0.3, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> save_wavefront("wavefront.csv", fs.fit_wavefront(slopes, layout, modes=5))
    """
    path = Path(path)
    check_wavefront_file(path)
    if path.suffix.lower() == ".json":
        write_atomically(path, to_json(_values(wavefront), indent=1))
    elif path.suffix.lower() == ".csv":
        write_atomically(path, _csv(wavefront))
    else:
        write_atomically(path, _fits(wavefront))


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
    is_csv = path.suffix.lower() == ".csv"
    write_atomically(path, _map_csv(wavefront, zonal) if is_csv else _map_fits(wavefront, layout, zonal))


def check_wavefront_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, *_WAVEFRONT_ENDINGS)


def check_map_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, *_MAP_ENDINGS)


def _csv(wavefront: Wavefront) -> str:
    names = [
        f"noll{mode['noll']}_osa{mode['osa']}_"
        + "_".join(re.findall(r"\w+", mode["name"].replace("°", "deg")))
        for mode in mode_records(wavefront)
    ]
    quantities = ["rms", "rms_without_tilt", *names, *(f"{name}_standard_error" for name in names)]
    coefficients = np.concatenate([wavefront.mean[None], wavefront.coefficients])
    errors = np.concatenate([wavefront.mean_standard_error[None], wavefront.standard_errors])
    columns = [total(coefficients), total(coefficients, tilt=False), *coefficients.T, *errors.T]
    frames = ["mean", *range(len(wavefront.coefficients))]
    cells = zip(frames, _cells(np.stack(columns, axis=1)), strict=True)
    header = ["frame", *(f"{name}_{_name_of_unit(wavefront)}" for name in quantities)]
    return csv_text(header, [[frame, *row] for frame, row in cells])


def _map_csv(wavefront: Wavefront, zonal: ZonalMap | None) -> str:
    sheets, line = _sheets(wavefront, zonal)
    unit = _name_of_unit(wavefront)
    header = ["x_px", "y_px", *(name if name == "part" else f"{name}_{unit}" for name in sheets)]
    known = np.logical_or.reduce([np.isfinite(sheet) for sheet in sheets.values()])
    (x, y), (row, column) = wavefront.pupil.centre_px, np.nonzero(known)
    columns = [x + line[column], y + line[row], *(sheet[known] for sheet in sheets.values())]
    return csv_text(header, list(_cells(np.stack(columns, axis=1))))


def _name_of_unit(wavefront: Wavefront) -> str:
    return wavefront.unit if wavefront.unit in UNITS else "px_subaperture"


def _cells(rows: Floats) -> Iterable[list[str]]:
    """Yield rows of numbers as text, empty where they are not known."""
    return ([f"{value:.7g}" if np.isfinite(value) else "" for value in row] for row in rows.tolist())


def _values(wavefront: Wavefront) -> dict[str, Any]:
    """Return a wavefront as plain values, with the reasons for those that are not known."""
    values = {
        "unit": wavefront.unit,
        "pupil_radius_m": wavefront.pupil.radius_m,
        "pupil_radius_subapertures": wavefront.pupil.radius_subapertures,
        "standard_errors_from": wavefront.errors_from,
        "condition": wavefront.condition,
        "left_out": wavefront.left_out,
        "mean": {
            "rms": float(total(wavefront.mean)),
            "rms_without_tilt": float(total(wavefront.mean, tilt=False)),
            "modes": mode_records(wavefront),
        },
        "frames": {
            "rms": wavefront.rms(),
            "rms_without_tilt": wavefront.rms(tilt=False),
            "residual_px": wavefront.residual_px,
            "coefficients": wavefront.coefficients,
            "standard_errors": wavefront.standard_errors,
        },
    }
    unknown = {}
    if wavefront.pupil.radius_m is None:
        unknown["pupil_radius_m"] = "the layout has neither subaperture_m nor diameter_m"
    if not wavefront.fitted.all():
        unknown["frames"] = "too few valid sub-apertures to separate the modes"
    elif not np.isfinite(wavefront.standard_errors).all():
        unknown["standard_errors"] = "no standard errors of the slopes, and no residuals to replace them"
    wave = {} if wavefront.wavelength_nm is None else {"wavelength_nm": wavefront.wavelength_nm}
    return {**values, **wave, "unknown": unknown}


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


def _fits(wavefront: Wavefront) -> bytes:
    primary = load_fits().PrimaryHDU(wavefront.sheet().astype(np.float32))
    primary.header["SUBAPRAD"] = (wavefront.pupil.radius_subapertures, "radius of the disk, sub-apertures")
    if wavefront.pupil.radius_m is not None:
        primary.header["PUPILRAD"] = (wavefront.pupil.radius_m, "radius of the disk, m")
    primary.header["ERRFROM"] = (wavefront.errors_from, "source of the standard errors")
    records = mode_records(wavefront)
    columns = {name: np.array([record[name] for record in records]) for name in _FITS_FORMATS}
    columns["name"] = np.char.replace(columns["name"], "°", " deg")
    modes = _fits_table(
        "MODES", {name: (_FITS_FORMATS[name], column) for name, column in columns.items()}, wavefront
    )
    images = {"COEFFICIENTS": wavefront.coefficients, "STANDARD_ERRORS": wavefront.standard_errors}
    units = [load_fits().ImageHDU(values, name=name) for name, values in images.items()]
    return _fits_file([primary, modes, *units], wavefront)


def _map_fits(wavefront: Wavefront, layout: Layout, zonal: ZonalMap | None) -> bytes:
    sheets, line = _sheets(wavefront, zonal)
    units: list[Any] = [load_fits().PrimaryHDU()]
    for name, sheet in sheets.items():
        image = load_fits().ImageHDU(sheet.astype(np.float32), name=name.upper())
        for axis, centre in enumerate(wavefront.pupil.centre_px, start=1):
            image.header[f"CRPIX{axis}"] = 1.0
            image.header[f"CRVAL{axis}"] = (centre + line[0], "pixel of the frame, from 0")
            image.header[f"CDELT{axis}"] = line[1] - line[0]
        units.append(image)
    if zonal is not None:
        (row, column), (x, y) = layout.cells.T, layout.centres.T
        columns = {"row": ("J", row), "column": ("J", column), "part": ("J", zonal.parts)}
        columns |= {"x": ("D", x), "y": ("D", y)}
        columns |= {"zonal": ("D", zonal.values), "standard_error": ("D", zonal.standard_errors)}
        units.append(_fits_table("SUBAPERTURES", columns, wavefront))
    return _fits_file(units, wavefront)


def _fits_table(name: str, columns: dict[str, tuple[str, Any]], wavefront: Wavefront) -> Any:
    """Return a table; real numbers are in the wavefront's unit, positions in pixels."""
    fits = load_fits()
    made = [
        fits.Column(
            title.upper(),
            kind,
            None if kind != "D" else "pixel" if title in ("x", "y") else _fits_unit(wavefront),
            array=array,
        )
        for title, (kind, array) in columns.items()
    ]
    return fits.BinTableHDU.from_columns(made, name=name)


def _fits_unit(wavefront: Wavefront) -> str:
    return wavefront.unit if wavefront.unit in UNITS else "pixel"


def _fits_file(units: list[Any], wavefront: Wavefront) -> bytes:
    """Return a file, with the unit of each image in its header."""
    unit = _fits_unit(wavefront)
    for image in units:
        if image.is_image and image.data is not None and image.name != "PART":
            image.header["BUNIT"] = (unit, "times sub-apertures" if unit == "pixel" else "")
    units[0].header["CREATOR"] = "faintspot"
    if wavefront.wavelength_nm is not None:
        units[0].header["WAVELEN"] = (wavefront.wavelength_nm, "length of a wave, nm")
    stream = io.BytesIO()
    load_fits().HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()
