"""Wavefronts in words and in files: CSV or JSON by the ending of the name, maps as FITS."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import check_ending, csv_text, write_atomically
from faintspot.base.json_text import to_json
from faintspot.base.report.texts import Texts, number_or_dash, signed
from faintspot.base.statistics import rms
from faintspot.io.optional_packages import load_fits
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront.fit import UNITS, Floats, Wavefront, total
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm, osa_index
from faintspot.slopes.wavefront.zonal import ZonalMap, compared

_TEXT = Texts("faintspot.slopes.wavefront")
_TILTS = (True, False)


def mode_records(wavefront: Wavefront) -> list[dict[str, Any]]:
    """Return each mode of the mean wavefront: indices, name, coefficient and standard error."""
    modes = zip(wavefront.modes.tolist(), wavefront.mean, wavefront.mean_standard_error, strict=True)
    return [
        {
            "noll": j,
            "osa": osa_index(j),
            **dict(zip("nm", noll_to_nm(j), strict=True)),
            "name": mode_name(j),
            "mean": mean,
            "standard_error": error,
        }
        for j, mean, error in modes
    ]


def mode_table(wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: each mode of the mean wavefront with its standard error, and its rms."""
    several, unit = np.count_nonzero(wavefront.fitted) > 1, wavefront.unit
    header = ["Noll", "name", "OSA", f"{'mean' if several else 'value'} ({unit})", "± standard error"]
    digits = _decimals(wavefront.rms_of_frames)
    rows = []
    for mode, of_frames in zip(mode_records(wavefront), wavefront.rms_of_frames, strict=True):
        numbers = signed(mode["mean"], digits), number_or_dash(mode["standard_error"], digits)
        row = [f"Z{mode['noll']}", mode["name"], str(mode["osa"]), *numbers]
        rows.append([*row, f"{of_frames:.{digits}f}"] if several else row)
    return [*header, f"rms of frames ({unit})"] if several else header, rows


def rms_table(wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: rms over the disk of the mean wavefront and of the frames, and noise."""
    several = np.count_nonzero(wavefront.fitted) > 1
    noise = np.sqrt(np.mean(wavefront.standard_errors[wavefront.fitted] ** 2, axis=0))
    coefficients = {"mean wavefront" if several else "wavefront": wavefront.mean}
    errors = [wavefront.mean_standard_error, noise]
    if several:
        coefficients["frames, quadratic mean"] = wavefront.rms_of_frames
    digits = _decimals(np.array([total(values) for values in coefficients.values()]))
    rows = [
        [
            name,
            *(
                number_or_dash(float(total(part, tilt=tilt)), digits)
                for part in pair
                for tilt in (True, False)
            ),
        ]
        for (name, *pair) in zip(coefficients, coefficients.values(), errors, strict=False)
    ]
    header = [f"rms over the pupil ({wavefront.unit})", "all modes", "no tip, tilt"]
    return [*header, "standard error", "no tip, tilt"], rows


def remarks(wavefront: Wavefront) -> list[str]:
    """Return remarks for the reader: sizes, units, source of the errors, frames that could not be fitted."""
    pupil, fitted = wavefront.pupil, int(np.count_nonzero(wavefront.fitted))
    size = "" if pupil.radius_m is None else f" ({2 * pupil.radius_m:.3g} m)"
    return _TEXT.lines(
        "remarks",
        wavefront,
        first=wavefront.modes[0],
        last=wavefront.modes[-1],
        diameter=2 * pupil.radius_subapertures,
        size=size + (" around those with flux" if pupil.part else ""),
        in_pixels=wavefront.unit not in UNITS,
        in_waves=wavefront.unit == "waves",
        has_errors=wavefront.errors_from == "slopes",
        without=wavefront.left_out.capitalize() or None,
        several=fitted > 1,
        frames=len(wavefront.fitted),
        lost=len(wavefront.fitted) - fitted or None,
        scatter=float(np.sqrt(np.mean(wavefront.residual_px[wavefront.fitted] ** 2))),
    )


def zonal_table(zonal: ZonalMap, wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: rms over the sub-apertures of a zonal map, the modes and their difference."""
    whole, still = compared(zonal, wavefront), compared(zonal, wavefront, tilt=False)
    values = np.array([[rms(whole[name]), rms(still[name])] for name in whole])
    digits = _decimals(values)
    rows = [
        [name, *(f"{value:.{digits}f}" for value in pair), ""]
        for name, pair in zip(whole, values, strict=True)
    ]
    rows[0][-1] = number_or_dash(rms(zonal.standard_errors), digits)
    header = f"rms over the sub-apertures ({zonal.unit})"
    return [header, "with tip, tilt", "no tip, tilt", "standard error"], rows


def zonal_remarks(zonal: ZonalMap, wavefront: Wavefront) -> list[str]:
    """Return remarks for the reader: method, errors, parts without a common piston, what was left out."""
    sizes = np.bincount(zonal.parts[zonal.parts >= 0])
    return _TEXT.lines(
        "zonal",
        zonal,
        errors=_TEXT[f"errors.{zonal.errors_from}"],
        parts=len(sizes) if len(sizes) > 1 else None,
        listed=", ".join(map(str, sizes[:6])) + (", ..." if len(sizes) > 6 else ""),
        without=zonal.left_out if zonal.left_out not in ("", wavefront.left_out) else None,
    )


def _decimals(values: Floats) -> int:
    """Return the number of decimals that shows the largest value with four digits."""
    largest = float(np.abs(values).max())
    return 3 if largest == 0 else int(np.clip(3 - np.floor(np.log10(largest)), 0, 6))


_WAVEFRONT_ENDINGS, _MAP_ENDING = (".csv", ".json"), ".fits"


def save_wavefront(path: str | Path, wavefront: Wavefront) -> None:
    """Write a wavefront to a file, replacing an existing one.

    Parameters
    ----------
    path : path
        .csv: a row for the mean and one for each frame, with rms, coefficients and standard errors. .json:
        the same by name, and the modes. A frame that could not be fitted is empty or null.
    wavefront : Wavefront

    Raises
    ------
    InputError
        When the ending is unknown or the file cannot be written.

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
    is_csv = path.suffix.lower() == ".csv"
    write_atomically(path, _csv(wavefront) if is_csv else to_json(_values(wavefront), indent=1))


def save_map(path: str | Path, wavefront: Wavefront, layout: Layout, zonal: ZonalMap | None = None) -> None:
    """Write the map of the mean wavefront to a FITS file, replacing an existing one.

    Parameters
    ----------
    path : path
        An image for each quantity, in the frame's coordinates; with a zonal map also the table SUBAPERTURES.
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
        When astropy is not installed.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import save_map
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5)
    >>> frame = np.random.default_rng(1).poisson(5.0, layout.frame_shape)
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frame)
    >>> save_map("map.fits", fs.fit_wavefront(slopes, layout, modes=5), layout)
    """
    path = Path(path)
    check_map_file(path)
    write_atomically(path, _map_fits(wavefront, layout, zonal))


def check_wavefront_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, *_WAVEFRONT_ENDINGS)


def check_map_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, _MAP_ENDING)


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
    unit = wavefront.unit if wavefront.unit in UNITS else "px_subaperture"
    frames, values = ["mean", *range(len(wavefront.coefficients))], np.stack(columns, axis=1).tolist()
    rows = [
        [frame, *(f"{value:.7g}" if np.isfinite(value) else "" for value in row)]
        for frame, row in zip(frames, values, strict=True)
    ]
    return csv_text(["frame", *(f"{name}_{unit}" for name in quantities)], rows)


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
    unit = wavefront.unit if wavefront.unit in UNITS else "pixel"
    for image in units[1:]:
        if image.name != "PART":
            image.header["BUNIT"] = (unit, "times sub-apertures" if unit == "pixel" else "")
    if zonal is not None:
        (row, column), (x, y) = layout.cells.T, layout.centres.T
        table = {
            "ROW": ("J", None, row),
            "COLUMN": ("J", None, column),
            "PART": ("J", None, zonal.parts),
            "X": ("D", "pixel", x),
            "Y": ("D", "pixel", y),
            "ZONAL": ("D", unit, zonal.values),
            "STANDARD_ERROR": ("D", unit, zonal.standard_errors),
        }
        columns = [load_fits().Column(name, *form, array=array) for name, (*form, array) in table.items()]
        units.append(load_fits().BinTableHDU.from_columns(columns, name="SUBAPERTURES"))
    units[0].header["CREATOR"] = "faintspot"
    if wavefront.wavelength_nm is not None:
        units[0].header["WAVELEN"] = (wavefront.wavelength_nm, "length of a wave, nm")
    stream = io.BytesIO()
    load_fits().HDUList(units).writeto(stream, checksum=True)
    return stream.getvalue()
