"""A wavefront as tables and sentences, for the terminal and for pages."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.report.texts import Texts, number_or_dash, signed
from faintspot.base.statistics import rms
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
