"""Wavefronts in words and in JSON files."""

from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.files import check_ending, write_atomically
from faintspot.base.report.texts import NOTHING, Texts, number_or_dash, signed
from faintspot.base.statistics import Estimate
from faintspot.base.text_files import to_json
from faintspot.slopes.wavefront.certificate import Certificate, Drift, certify
from faintspot.slopes.wavefront.fit import NM, Wavefront, total
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm, osa_index

_TEXT = Texts("faintspot.slopes.wavefront")
WAVEFRONT_ENDING = ".json"


def mode_records(wavefront: Wavefront) -> list[dict[str, Any]]:
    """Return each mode of the mean wavefront: indices, name, coefficient, standard error, interval."""
    values = wavefront.mean, wavefront.mean_standard_error, wavefront.mean_half_width
    modes = zip(wavefront.modes.tolist(), *values, strict=True)
    return [
        {
            "noll": j,
            "osa": osa_index(j),
            **dict(zip("nm", noll_to_nm(j), strict=True)),
            "name": mode_name(j),
            "mean": mean,
            "standard_error": error,
            "low": mean - half,
            "high": mean + half,
        }
        for j, mean, error, half in modes
    ]


def mode_table(wavefront: Wavefront, most: int | None = None) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: each mode of the mean wavefront with its standard error, and its rms.

    One row stands for all modes after the first `most`.
    """
    several, unit = np.count_nonzero(wavefront.fitted) > 1, wavefront.unit
    header = ["Noll", "name", "OSA", f"{'mean' if several else 'value'} ({unit})", "± standard error"]
    digits = _decimals(wavefront.rms_of_frames)
    if len(wavefront.modes) > 2:  # tilt may be far larger than the others
        digits = min(digits + 2, _decimals(wavefront.rms_of_frames[2:]))
    rows = []
    for mode, of_frames in zip(mode_records(wavefront), wavefront.rms_of_frames, strict=True):
        numbers = signed(mode["mean"], digits), number_or_dash(mode["standard_error"], digits)
        row = [f"Z{mode['noll']}", mode["name"], str(mode["osa"]), *numbers]
        rows.append([*row, f"{of_frames:.{digits}f}"] if several else row)
    if most is not None and len(rows) > most + 1:
        last, rest = wavefront.modes[-1], [NOTHING, f"{total(wavefront.mean[most:]):.{digits}f}", NOTHING]
        name = f"to Z{last}, rms (--modes {len(rows)})"
        row = [rows[most][0], name, *rest, f"{total(wavefront.rms_of_frames[most:]):.{digits}f}"]
        rows[most:] = [row if several else row[:-1]]
    return [*header, f"rms of frames ({unit})"] if several else header, rows


def certificate_table(found: Certificate, unit: str) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: each known number of a certificate with its 95 % interval."""
    rows = [
        [
            _TEXT(f"certificate.{name}", found, unit=unit),
            *(f"{number:.4g}" if np.isfinite(number) else NOTHING for number in numbers.values()),
        ]
        for name, numbers in certificate_records(found).items()
        if np.isfinite(numbers["value"])
    ]
    return [_TEXT["certificate.title"], "value", "± standard error", "from", "to"], rows


def drift_table(found: Drift, wavefront: Wavefront) -> tuple[list[str], list[list[str]]]:
    """Return header and rows: the linear drift of each mode with its standard error and 95 % interval."""
    rate, half = found.rate, found.rate_half_width
    numbers = np.stack([rate, found.rate_standard_error, rate - half, rate + half], axis=1)
    rows = [
        [f"Z{j}", mode_name(j), *(f"{value:.3g}" for value in row)]
        for j, row in zip(wavefront.modes.tolist(), numbers, strict=True)
    ]
    unit = f"{wavefront.unit}/{found.time_unit}"
    return ["Noll", "name", f"drift ({unit})", "± standard error", "from", "to"], rows


def certificate_records(found: Certificate) -> dict[str, dict[str, float]]:
    """Return value, standard error and ends of the 95 % interval of each number of a certificate."""
    names = "value", "standard_error", "low", "high"
    return {
        key: {name: getattr(number, name) for name in names}
        for key, number in vars(found).items()
        if isinstance(number, Estimate)
    }


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
        error=f" ± {2 * pupil.error_subapertures:.1g}" if pupil.error_subapertures else "",
        x=pupil.centre_px[0],
        y=pupil.centre_px[1],
        radius=pupil.radius_px,
        size=size + (" around those with flux" if pupil.part else ""),
        in_pixels=wavefront.unit != NM,
        has_errors=wavefront.errors_from == "slopes",
        without=wavefront.left_out.capitalize() or None,
        several=fitted > 1,
        of_frames=float(total(wavefront.rms_of_frames)),
        without_tilt=float(total(wavefront.rms_of_frames, tilt=False)),
        noise=float(np.sqrt(np.trace(wavefront.noise_covariance))),
        frames=len(wavefront.fitted),
        lost=len(wavefront.fitted) - fitted or None,
        scatter=float(np.sqrt(np.mean(wavefront.residual_px[wavefront.fitted] ** 2))),
    )


def _decimals(values: Floats) -> int:
    """Return the number of decimals that shows the largest value with four digits."""
    largest = float(np.abs(values).max())
    return 3 if largest == 0 else int(np.clip(3 - np.floor(np.log10(largest)), 0, 6))


def save_wavefront(
    path: str | Path, wavefront: Wavefront, found: Certificate | None = None, drift: Drift | None = None
) -> None:
    """Write a wavefront to a file, replacing an existing one.

    Parameters
    ----------
    path : path
        .json: unit, pupil, modes and certificate of the mean with 95 % intervals, and rms, coefficients and
        standard errors of each frame; null for a frame that could not be fitted.
    wavefront : Wavefront
    found : Certificate, optional
        Default: that of the wavefront, without Strehl ratio.
    drift : Drift, optional
        Modes against time.

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
    >>> save_wavefront("wavefront.json", fs.fit_wavefront(slopes, layout, modes=5))
    """
    path = Path(path)
    check_ending(path, WAVEFRONT_ENDING)
    over_time = {} if drift is None else {"drift": vars(drift)}
    write_atomically(
        path, to_json({**_values(wavefront, found or certify(wavefront)), **over_time}, indent=1)
    )


def _values(wavefront: Wavefront, found: Certificate) -> dict[str, Any]:
    """Return a wavefront as plain values, with the reasons for those that are not known."""
    values = {
        "unit": wavefront.unit,
        "pupil_radius_m": wavefront.pupil.radius_m,
        "pupil_radius_subapertures": wavefront.pupil.radius_subapertures,
        "pupil_radius_error_subapertures": wavefront.pupil.error_subapertures,
        "pupil_centre_px": wavefront.pupil.centre_px,
        "pupil_radius_px": wavefront.pupil.radius_px,
        "standard_errors_from": wavefront.errors_from,
        "condition": wavefront.condition,
        "left_out": wavefront.left_out,
        "mean": {
            "certificate": certificate_records(found),
            "wavelength_nm": found.wavelength_nm,
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
    unknown = dict(_TEXT.facts("unknown", found, wavelength=found.wavelength_nm is None))
    if wavefront.pupil.radius_m is None:
        unknown["pupil_radius_m"] = "the layout has neither subaperture_m nor diameter_m"
    if not wavefront.fitted.all():
        unknown["frames"] = "too few valid sub-apertures to separate the modes"
    elif not np.isfinite(wavefront.standard_errors).all():
        unknown["standard_errors"] = "no standard errors of the slopes, and no residuals to replace them"
    return {**values, "unknown": unknown}
