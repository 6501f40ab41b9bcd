"""Wavefronts in words and in JSON files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.files import check_ending, write_atomically
from faintspot.base.json_text import to_json
from faintspot.base.report.texts import Texts, number_or_dash, signed
from faintspot.slopes.wavefront.fit import NM, Floats, Wavefront, total
from faintspot.slopes.wavefront.zernike import mode_name, noll_to_nm, osa_index

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
        in_pixels=wavefront.unit != NM,
        has_errors=wavefront.errors_from == "slopes",
        without=wavefront.left_out.capitalize() or None,
        several=fitted > 1,
        frames=len(wavefront.fitted),
        lost=len(wavefront.fitted) - fitted or None,
        scatter=float(np.sqrt(np.mean(wavefront.residual_px[wavefront.fitted] ** 2))),
    )


def _decimals(values: Floats) -> int:
    """Return the number of decimals that shows the largest value with four digits."""
    largest = float(np.abs(values).max())
    return 3 if largest == 0 else int(np.clip(3 - np.floor(np.log10(largest)), 0, 6))


def save_wavefront(path: str | Path, wavefront: Wavefront) -> None:
    """Write a wavefront to a file, replacing an existing one.

    Parameters
    ----------
    path : path
        .json: unit, pupil, modes, and rms, coefficients and standard errors of the mean and of each frame;
        null for a frame that could not be fitted.
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
    >>> save_wavefront("wavefront.json", fs.fit_wavefront(slopes, layout, modes=5))
    """
    path = Path(path)
    check_wavefront_file(path)
    write_atomically(path, to_json(_values(wavefront), indent=1))


def check_wavefront_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, ".json")


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
    return {**values, "unknown": unknown}
