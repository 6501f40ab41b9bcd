"""A wavefront as tables and sentences, for the terminal and for pages."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.report.texts import number_or_dash, signed
from faintspot.base.statistics import rms
from faintspot.slopes.wavefront.fit import Floats, Wavefront, total
from faintspot.slopes.wavefront.units import UNITS
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm, osa_index
from faintspot.slopes.wavefront.zonal import ZonalMap, compared


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
    several = np.count_nonzero(wavefront.fitted) > 1
    header = ["Noll", "name", "OSA", "n", "m", f"{'mean' if several else 'value'} ({wavefront.unit})"]
    header += ["± standard error"] + ([f"rms of frames ({wavefront.unit})"] if several else [])
    digits = _decimals(wavefront.rms_of_frames)
    rows = []
    for mode, of_frames in zip(mode_records(wavefront), wavefront.rms_of_frames, strict=True):
        mean, error = signed(mode["mean"], digits), number_or_dash(mode["standard_error"], digits)
        row = [
            f"Z{mode['noll']}",
            mode["name"],
            *(str(mode[name]) for name in ("osa", "n", "m")),
            mean,
            error,
        ]
        rows.append([*row, f"{of_frames:.{digits}f}"] if several else row)
    return header, rows


def rms_table(wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: rms over the disk of the mean wavefront and of the frames, and noise."""
    kept = wavefront.fitted
    several = np.count_nonzero(kept) > 1
    noise = wavefront.standard_errors[kept]
    coefficients = {
        "mean wavefront" if several else "wavefront": (wavefront.mean, wavefront.mean_standard_error)
    }
    if several:
        rms = wavefront.rms_of_frames
        coefficients["frames, quadratic mean"] = (rms, np.sqrt(np.mean(noise**2, axis=0)))
    all_values = [total(pair[0]) for pair in coefficients.values()]
    digits = _decimals(np.array(all_values))
    rows = [
        [
            name,
            *(
                number_or_dash(float(total(part, tilt=tilt)), digits)
                for part in pair
                for tilt in (True, False)
            ),
        ]
        for name, pair in coefficients.items()
    ]
    header = [f"rms over the pupil ({wavefront.unit})", "all modes", "no tip, tilt"]
    return [*header, "standard error", "no tip, tilt"], rows


def remarks(wavefront: Wavefront) -> list[str]:
    """Return remarks for the reader: sizes, units, source of the errors, frames that could not be fitted."""
    pupil = wavefront.pupil
    modes, frames = wavefront.modes, len(wavefront.fitted)
    size = "" if pupil.radius_m is None else f" ({2 * pupil.radius_m:.3g} m)"
    size += " around those with flux" if pupil.part else ""
    lines = [
        f"Zernike modes Z{modes[0]} to Z{modes[-1]} in Noll's order on a disk of "
        f"{2 * pupil.radius_subapertures:.3g} sub-apertures{size}, fitted by least squares; condition number "
        f"{wavefront.condition:.3g}. All rms values are over the whole disk, including obscured parts. "
        "Higher orders leak partly into the two highest fitted orders. OSA is the index in the standard of "
        "OSA and ANSI."
    ]
    if wavefront.unit not in UNITS:
        lines.append(
            "In pixels times sub-apertures; for nm, add pixel_scale_arcsec and subaperture_m or diameter_m "
            "to the layout (faintspot layout --pixel-scale-arcsec, --subaperture-m, --diameter-m)."
        )
    if wavefront.unit == "waves":
        lines.append(f"Waves have a length of {wavefront.wavelength_nm:g} nm.")
    if wavefront.errors_from == "slopes":
        noise = "The noise is computed from the slopes' standard errors."
    else:
        noise = (
            "The slopes have no standard errors: the noise is estimated from their residuals about the "
            "fitted modes, which include higher modes."
        )
    lines.append(noise)
    if wavefront.left_out:
        lines.append(f"{wavefront.left_out.capitalize()}.")
    fitted = int(np.count_nonzero(wavefront.fitted))
    if fitted > 1:
        lines.append(
            "Standard errors of the mean come from the scatter over frames, motion of the wavefront "
            "included, as if frames were independent."
        )
    if fitted < frames:
        lines.append(
            f"{frames - fitted} of {frames} frames have too few valid sub-apertures and were left out."
        )
    scatter = float(np.sqrt(np.mean(wavefront.residual_px[wavefront.fitted] ** 2)))
    lines.append(f"The slopes scatter about the fitted modes by {scatter:.3g} px rms per axis.")
    return lines


def zonal_table(zonal: ZonalMap, wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: rms over the sub-apertures of a zonal map, the modes and their difference."""
    rows = []
    sheets = compared(zonal, wavefront), compared(zonal, wavefront, tilt=False)
    values = [[rms(sheet) for sheet in part.values()] for part in sheets]
    digits = _decimals(np.array(values))
    for name, *numbers in zip(sheets[0], *values, strict=True):
        rows.append([name, *(f"{number:.{digits}f}" for number in numbers), ""])
    rows[0][-1] = number_or_dash(rms(zonal.standard_errors), digits)
    header = f"rms over the sub-apertures ({zonal.unit})"
    return [header, "with tip, tilt", "no tip, tilt", "standard error"], rows


_ERRORS = {
    "frames": "come from the scatter over frames, as if frames were independent",
    "slopes": "are computed from those of the slopes",
    "residuals": "are estimated from the residuals of the slopes, which have no standard errors",
}


def zonal_remarks(zonal: ZonalMap, wavefront: Wavefront) -> list[str]:
    """Return remarks for the reader: method, errors, parts without a common piston, what was left out."""
    sizes = np.bincount(zonal.parts[zonal.parts >= 0])
    lines = [
        "Zonal map: a smooth surface through the slopes, without modes. Its standard errors "
        f"{_ERRORS[zonal.errors_from]}. They are relative to the mean, without structure finer than a "
        f"sub-aperture. The slopes scatter about the surface by {zonal.residual_px:.3g} px rms per axis."
    ]
    if len(sizes) > 1:
        listed = ", ".join(map(str, sizes[:6])) + (", ..." if len(sizes) > 6 else "")
        lines.append(
            f"The pupil has {len(sizes)} parts without a common edge ({listed} sub-apertures). Slopes do not "
            "show steps between them: the mean of each part is set to 0 (the modes' too, in the comparison)."
        )
    if zonal.left_out not in ("", wavefront.left_out):
        lines.append(f"Of the zonal map {zonal.left_out}.")
    return lines


def _decimals(values: Floats) -> int:
    """Return the number of decimals that shows the largest value with four digits."""
    largest = float(np.abs(values).max())
    return 3 if largest == 0 else int(np.clip(3 - np.floor(np.log10(largest)), 0, 6))
