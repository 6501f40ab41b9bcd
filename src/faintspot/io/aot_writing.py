"""Writing telemetry as a file of the Adaptive Optics Telemetry standard (AOT, FITS), with aotpy.

Dimensions and units follow the documentation of aotpy 3 (https://pypi.org/project/aotpy/). AOT has fields for
slopes, fluxes, frames and times. It has none for the noise of slopes, flags, iterations, the interleaved
configurations and denoised images: these stay in the Zarr store.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import write_atomically
from faintspot.base.text_files import parse_text, to_json
from faintspot.io.fits_units import SIDE
from faintspot.io.telemetry import CLOSED_LOOP, Telemetry

_ARCSEC = np.pi / 180 / 3600
AO_MODES = ("SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO")


def write_aot(path: str | Path, telemetry: Telemetry, *, ao_mode: str = "SCAO") -> None:
    """Write telemetry to an AOT file.

    AOT demands a telescope, a source and a mode; the first two are names, with the diameter if it is known.
    Slopes are `measurements` (t, 2, n), px, x and y, NaN where not valid. They were published with the
    reference subtracted, which is stored as `ref_measurements`, px from the centre of each window. Fluxes
    are sums over the sub-aperture in electrons after background subtraction; the standard has averages in
    ADU. The keyword CONFIG holds the initial estimator and settings; CHG1, CHG2 and so on hold changes. The
    loop has its commands and says whether it was ever closed; its interaction matrix is not written. All
    data are in memory at once.

    Parameters
    ----------
    path : path
        A FITS file that does not exist yet.
    telemetry : Telemetry
        Telemetry with at least one frame.
    ao_mode : {"SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO"}
        AO mode of the system.

    Raises
    ------
    InputError
        When there is no frame, or the file exists or cannot be written.
    MissingExtraError
        When aotpy is not installed.

    Examples
    --------
    >>> from faintspot.io import read_telemetry, write_aot
    >>> write_aot("night.fits", read_telemetry("night.zarr"))  # doctest: +SKIP
    """
    try:
        from aotpy.io.fits import AOTFITSWriter
    except ImportError:
        raise MissingExtraError("aotpy", "realtime", "Writing an AOT file") from None
    target = Path(path)
    one_of("ao_mode", ao_mode, AO_MODES)
    if not len(telemetry.frame):
        raise InputError("telemetry: expected at least one frame, got none")
    if target.exists():
        raise InputError(f"{target}: already exists; choose another name")
    file = AOTFITSWriter(_system(telemetry, ao_mode)).get_hdulist()
    write_atomically(target, file.writeto)


def _system(telemetry: Telemetry, ao_mode: str) -> Any:
    """Return the system as aotpy represents it."""
    import aotpy

    unix = telemetry.unix_time_s
    attributes = telemetry.attributes
    tables = parse_text(attributes["settings"], "settings of the recording")
    source = aotpy.NaturalGuideStar("SOURCE")
    telescope = aotpy.MainTelescope("TELESCOPE", enclosing_diameter=attributes["layout"].get("diameter_m"))
    sensor = _sensor(telemetry, source, tables.get("estimator", {}).get("name"))
    commands = telemetry.commands.shape[1]
    mirror = aotpy.DeformableMirror("MIRROR", n_valid_actuators=max(commands, 1), telescope=telescope)
    loop = aotpy.ControlLoop(
        "LOOP",
        commanded_corrector=mirror,
        input_sensor=sensor,
        closed=bool((np.asarray(telemetry.loop) == CLOSED_LOOP).any()),
        commands=aotpy.Image("COMMANDS", np.asarray(telemetry.commands)) if commands else None,
    )
    return aotpy.AOSystem(
        ao_mode=ao_mode,
        name=str(attributes["name"]),
        date_beginning=datetime.fromtimestamp(unix[0], UTC),
        date_end=datetime.fromtimestamp(unix[-1], UTC),
        config=to_json(tables),
        main_telescope=telescope,
        sources=[source],
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[loop],
        metadata=_metadata(telemetry),
    )


def _metadata(telemetry: Telemetry) -> list[Any]:
    """Return keywords for data that have no field in AOT."""
    from aotpy import Metadatum

    side = telemetry.attributes["layout"].get("subaperture_m")
    dropped = int(telemetry.attributes["dropped_records"])
    return [
        Metadatum("ORIGIN", "faintspot"),
        Metadatum("DROPPED", dropped, "frames measured, lost by the recorder"),
        Metadatum("METHODS", ", ".join(telemetry.attributes["methods"]), "interleaved settings"),
        *([] if side is None else [Metadatum(SIDE, float(side), "m, side of a sub-aperture")]),
        *(Metadatum(f"CHG{i}", to_json(change)) for i, change in enumerate(telemetry.changes, 1)),
    ]


def _sensor(telemetry: Telemetry, source: object, estimator: str | None) -> object:
    """Return the Shack-Hartmann sensor with its measurements."""
    import aotpy

    attributes = telemetry.attributes
    layout = attributes["layout"]
    window, corners = layout["window"], np.array(layout["corners"])
    when = aotpy.Time(
        "FRAMES", timestamps=telemetry.unix_time_s.tolist(), frame_numbers=telemetry.frame.tolist()
    )
    valid = telemetry.valid[:, None]
    slopes = np.where(valid, np.stack([telemetry.x, telemetry.y], axis=1), np.float32(np.nan))
    subtracted = aotpy.Metadatum("REFSUB", True, "reference has been subtracted already")
    summed = aotpy.Metadatum("FLUXSUM", True, "sum over the sub-aperture after background")
    middle = corners[:, ::-1] + 0.5 * (np.array(window[::-1]) - 1)
    taken_off = attributes.get("reference")
    reference = (np.array(layout["centres"]) - middle).T
    if taken_off is not None:
        reference = reference + np.reshape(taken_off, reference.shape)
    sensor = aotpy.ShackHartmann(
        uid="SENSOR",
        source=source,
        n_valid_subapertures=len(corners),
        measurements=aotpy.Image("SLOPES", slopes, "pix", when, [subtracted]),
        ref_measurements=aotpy.Image("REFERENCE", reference, "pix"),
        subaperture_intensities=aotpy.Image("FLUX", telemetry.flux, "electron", when, [summed]),
        subaperture_size=_size(window, corners, np.array(layout["cells"])),
        mask_offsets=[aotpy.Coordinates(float(corners[:, 1].min()), float(corners[:, 0].min()))],
        centroiding_algorithm=estimator,
        detector=_detector(telemetry),
    )
    mask = _mask(np.array(layout["cells"]))
    if mask is not None:
        sensor.subaperture_mask = aotpy.Image("SUBAPERTURES", mask)
    return sensor


def _size(window: Sequence[int], corners: NDArray[np.int64], cells: NDArray[np.int64]) -> float | None:
    """Return the side of square windows without gaps; the standard describes no others: None."""
    expected = corners.min(axis=0) + window[0] * (cells - cells.min(axis=0))
    return float(window[0]) if window[0] == window[1] and np.array_equal(corners, expected) else None


def _mask(cells: NDArray[np.int64]) -> NDArray[np.int32] | None:
    """Return a square grid with the number of each sub-aperture, -1 elsewhere; None if two share a cell."""
    indices = cells - cells.min(axis=0)
    mask = np.full((int(indices.max()) + 1,) * 2, -1, np.int32)
    mask[indices[:, 0], indices[:, 1]] = np.arange(len(indices))
    return mask if np.count_nonzero(mask >= 0) == len(indices) else None


def _detector(telemetry: Telemetry) -> object:
    """Return the detector with the recorded frames."""
    import aotpy

    scale = telemetry.attributes["layout"].get("pixel_scale_arcsec")
    detector = aotpy.Detector(uid="DETECTOR", pixel_scale=None if scale is None else scale * _ARCSEC)
    if len(telemetry.image_frame):
        numbers, rows = np.unique(telemetry.frame, return_index=True)
        nearest = np.minimum(np.searchsorted(numbers, telemetry.image_frame), len(numbers) - 1)
        all_recorded = bool(np.all(numbers[nearest] == telemetry.image_frame))
        times = telemetry.unix_time_s[rows[nearest]].tolist() if all_recorded else []  # for all or none
        when = aotpy.Time("IMAGES", timestamps=times, frame_numbers=telemetry.image_frame.tolist())
        detector.pixel_intensities = aotpy.Image("PIXELS", telemetry.raw, "adu", when)
    return detector
