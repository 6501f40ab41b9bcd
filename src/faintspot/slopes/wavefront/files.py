"""Wavefronts in files: CSV, JSON or FITS, by the ending of the name."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import check_ending, write_atomically
from faintspot.base.json_text import to_json
from faintspot.base.report.figure_data import csv_text
from faintspot.io.optional_packages import load_fits
from faintspot.slopes.wavefront.fit import Wavefront, total
from faintspot.slopes.wavefront.units import UNITS
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm, osa_index


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
    ...     layout.corners, layout.window, layout.frame_shape, 5, flux_e=1000.0,
    ...     positions=np.tile([0.3, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> save_wavefront("wavefront.csv", fs.fit_wavefront(slopes, layout, modes=5))
    """
    path = Path(path)
    check_wavefront_file(path)
    write_atomically(path, _WRITERS[path.suffix.lower()](wavefront))


def check_wavefront_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, *_WRITERS)


def _csv(wavefront: Wavefront) -> str:
    unit = wavefront.unit if wavefront.unit in UNITS else "px_subaperture"
    names = [_column(int(j)) for j in wavefront.modes]
    header = ["frame", f"rms_{unit}", f"rms_without_tilt_{unit}", *(f"{name}_{unit}" for name in names)]
    header += [f"{name}_standard_error_{unit}" for name in names]
    coefficients = np.concatenate([wavefront.mean[None], wavefront.coefficients])
    errors = np.concatenate([wavefront.mean_standard_error[None], wavefront.standard_errors])
    columns = [total(coefficients), total(coefficients, tilt=False), *coefficients.T, *errors.T]
    rows = []
    for number, values in enumerate(np.stack(columns, axis=1)):
        cells = (f"{value:.7g}" if np.isfinite(value) else "" for value in values)
        rows.append(("mean" if number == 0 else str(number - 1), *cells))
    return csv_text(header, rows)


def _column(j: int) -> str:
    """Return both indices and the name of a mode as the name of a column: noll5_osa3_astigmatism_45deg."""
    name = mode_name(j).replace("°", "deg")
    return f"noll{j}_osa{osa_index(j)}_" + "_".join(re.findall(r"\w+", name))


def _json(wavefront: Wavefront) -> str:
    modes = [
        {
            "noll": int(j),
            "osa": osa_index(int(j)),
            "n": n,
            "m": m,
            "name": mode_name(int(j)),
            "mean": mean,
            "standard_error": error,
        }
        for j, (n, m), mean, error in zip(
            wavefront.modes,
            (noll_to_nm(int(j)) for j in wavefront.modes),
            wavefront.mean,
            wavefront.mean_standard_error,
            strict=True,
        )
    ]
    values: dict[str, Any] = {
        "unit": wavefront.unit,
        "pupil_radius_m": wavefront.pupil.radius_m,
        "pupil_radius_subapertures": wavefront.pupil.radius_subapertures,
        "standard_errors_from": wavefront.errors_from,
        "condition": wavefront.condition,
        "left_out": wavefront.left_out,
        "mean": {
            "rms": float(total(wavefront.mean)),
            "rms_without_tilt": float(total(wavefront.mean, tilt=False)),
            "modes": modes,
        },
        "frames": {
            "rms": wavefront.rms(),
            "rms_without_tilt": wavefront.rms(tilt=False),
            "residual_px": wavefront.residual_px,
            "coefficients": wavefront.coefficients,
            "standard_errors": wavefront.standard_errors,
        },
    }
    if wavefront.wavelength_nm is not None:
        values["wavelength_nm"] = wavefront.wavelength_nm
    return to_json({**values, "unknown": _unknown(wavefront)}, indent=1)


def _unknown(wavefront: Wavefront) -> dict[str, str]:
    """Return why values are unknown (null), by name."""
    reasons = {}
    if wavefront.pupil.radius_m is None:
        reasons["pupil_radius_m"] = "the layout has neither subaperture_m nor diameter_m"
    if not wavefront.fitted.all():
        reasons["frames"] = "too few valid sub-apertures to separate the modes"
    elif not np.isfinite(wavefront.standard_errors).all():
        reasons["standard_errors"] = "no standard errors of the slopes, and no residuals to replace them"
    return reasons


def _fits(wavefront: Wavefront) -> bytes:
    fits = load_fits()
    unit = wavefront.unit if wavefront.unit in UNITS else "pixel"
    primary = fits.PrimaryHDU(wavefront.sheet().astype(np.float32))
    primary.header["BUNIT"] = (
        unit,
        "times sub-apertures" if unit == "pixel" else "mean wavefront over the disk",
    )
    primary.header["CREATOR"] = "faintspot"
    primary.header["SUBAPRAD"] = (wavefront.pupil.radius_subapertures, "radius of the disk, sub-apertures")
    if wavefront.pupil.radius_m is not None:
        primary.header["PUPILRAD"] = (wavefront.pupil.radius_m, "radius of the disk, m")
    primary.header["ERRFROM"] = (wavefront.errors_from, "source of the standard errors")
    if wavefront.wavelength_nm is not None:
        primary.header["WAVELEN"] = (wavefront.wavelength_nm, "length of a wave, nm")
    orders = np.array([noll_to_nm(int(j)) for j in wavefront.modes])
    columns = [
        fits.Column("NOLL", "J", array=wavefront.modes),
        fits.Column("OSA", "J", array=[osa_index(int(j)) for j in wavefront.modes]),
        fits.Column("NAME", "32A", array=[mode_name(int(j)).replace("°", " deg") for j in wavefront.modes]),
        fits.Column("N", "J", array=orders[:, 0]),
        fits.Column("M", "J", array=orders[:, 1]),
        fits.Column("MEAN", "D", unit, array=wavefront.mean),
        fits.Column("STANDARD_ERROR", "D", unit, array=wavefront.mean_standard_error),
    ]
    table = fits.BinTableHDU.from_columns(columns, name="MODES")
    images = [
        fits.ImageHDU(values, name=name)
        for name, values in (
            ("COEFFICIENTS", wavefront.coefficients),
            ("STANDARD_ERRORS", wavefront.standard_errors),
        )
    ]
    for image in images:
        image.header["BUNIT"] = unit
    stream = io.BytesIO()
    fits.HDUList([primary, table, *images]).writeto(stream, checksum=True)
    return stream.getvalue()


_WRITERS: dict[str, Callable[[Wavefront], str | bytes]] = {".csv": _csv, ".json": _json, ".fits": _fits}
