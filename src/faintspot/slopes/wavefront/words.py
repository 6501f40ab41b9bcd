"""A wavefront as tables and sentences, for the terminal and for pages."""

from __future__ import annotations

import numpy as np

from faintspot.slopes.wavefront.fit import Floats, Wavefront, total
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm


def mode_table(wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: each mode of the mean wavefront with its standard error, and its rms."""
    several = np.count_nonzero(wavefront.fitted) > 1
    header = ["mode", "name", "n", "m", f"{'mean' if several else 'value'} ({wavefront.unit})"]
    header += ["± standard error"] + ([f"rms of frames ({wavefront.unit})"] if several else [])
    digits = _decimals(wavefront.rms_of_frames)
    rows = []
    for j, mean, error, rms in zip(
        wavefront.modes, wavefront.mean, wavefront.mean_standard_error, wavefront.rms_of_frames, strict=True
    ):
        n, m = noll_to_nm(int(j))
        values = [
            f"{mean:+.{digits}f}".replace("-", "−"),
            f"{error:.{digits}f}" if np.isfinite(error) else "–",
        ]
        rows.append([f"Z{j}", mode_name(int(j)), str(n), str(m), *values])
        if several:
            rows[-1].append(f"{rms:.{digits}f}")
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
        [name, *(_cell(part, tilt, digits) for part in pair for tilt in (True, False))]
        for name, pair in coefficients.items()
    ]
    header = [f"rms over the pupil ({wavefront.unit})", "all modes", "no tip, tilt"]
    return [*header, "standard error", "no tip, tilt"], rows


def remarks(wavefront: Wavefront) -> list[str]:
    """Return remarks for the reader: sizes, units, source of the errors, frames that could not be fitted."""
    pupil = wavefront.pupil
    modes, frames = wavefront.modes, len(wavefront.fitted)
    size = "" if pupil.radius_m is None else f" ({2 * pupil.radius_m:.3g} m)"
    lines = [
        f"Zernike modes Z{modes[0]} to Z{modes[-1]} in Noll's order on a disk of "
        f"{2 * pupil.radius_subapertures:.3g} sub-apertures{size}, fitted by least squares; condition number "
        f"{wavefront.condition:.3g}. All rms values are over the whole disk, including obscured parts. "
        "Higher orders leak partly into the two highest fitted orders."
    ]
    if wavefront.unit != "nm":
        lines.append(
            "In pixels times sub-apertures; for nm, add pixel_scale_arcsec and subaperture_m or diameter_m "
            "to the layout (faintspot layout --pixel-scale-arcsec, --subaperture-m, --diameter-m)."
        )
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


def _cell(coefficients: Floats, tilt: bool, digits: int) -> str:
    value = float(total(coefficients, tilt=tilt))
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def _decimals(values: Floats) -> int:
    """Return the number of decimals that shows the largest value with four digits."""
    largest = float(np.abs(values).max())
    return 3 if largest == 0 else int(np.clip(3 - np.floor(np.log10(largest)), 0, 6))
