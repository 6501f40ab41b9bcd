"""Telemetry as a file of the Adaptive Optics Telemetry standard (AOT, FITS), by way of aotpy.

Dimensions and units are those of the documentation of aotpy 3 (https://pypi.org/project/aotpy/). AOT has
places for slopes, fluxes, frames and times. It has none for standard errors, flags, iterations, the arms of
interleaved settings and denoised images: they stay in the Zarr store.
"""

from __future__ import annotations

import json
import warnings
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.base.files import write_atomically
from faintspot.base.toml_files import parse_text
from faintspot.io.telemetry import Telemetry

# The standard wants both, and a sensor alone has neither.
_EXPECTED = r".AOT_(WAVEFRONT_CORRECTORS|LOOPS). .* contains no data"
AO_MODES = ("SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO")


def write_aot(path: str | Path, telemetry: Telemetry, *, ao_mode: str = "SCAO") -> None:
    """Write telemetry to an AOT file.

    Of the system, AOT demands a telescope, a source and a mode; the first two are there as names without
    data. Slopes are `measurements` (t, 2, n), px, x and y; they were published with the reference subtracted,
    which is `ref_measurements`, px from the middle of each window. Fluxes are sums over the sub-aperture,
    electrons after background subtraction, where the standard speaks of averages in ADU. Estimator and
    settings at the start are in the keyword CONFIG, changes in CHG1, CHG2 and so on, the layout and the
    reference slopes with all their digits in LAYOUT and SUBTRACT of the references, JSON texts. There are no
    wavefront correctors and loops, about which aotpy warns when it reads the file. All of it is in memory at
    once.

    Parameters
    ----------
    path : path
        A FITS file that does not exist yet.
    telemetry : Telemetry
        With at least one frame.
    ao_mode : {"SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO"}
        What the sensor is part of.

    Raises
    ------
    InputError
        When there is no frame, the file exists, or cannot be written.
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
        raise InputError(f"{target}: exists already: choose another name")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", _EXPECTED)
        file = AOTFITSWriter(_system(telemetry, ao_mode)).get_hdulist()
    write_atomically(target, file.writeto)


def _system(telemetry: Telemetry, ao_mode: str) -> Any:
    """The whole as aotpy has it."""
    import aotpy

    unix = telemetry.unix_time_s
    attributes = telemetry.attributes
    tables = parse_text(attributes["settings"], "settings of the recording")
    source = aotpy.NaturalGuideStar("SOURCE")
    return aotpy.AOSystem(
        ao_mode=ao_mode,
        name=str(attributes["name"]),
        date_beginning=datetime.fromtimestamp(unix[0], UTC),
        date_end=datetime.fromtimestamp(unix[-1], UTC),
        config=json.dumps(tables),
        main_telescope=aotpy.MainTelescope("TELESCOPE"),
        sources=[source],
        wavefront_sensors=[_sensor(telemetry, source, tables.get("estimator", {}).get("name"))],
        metadata=_metadata(telemetry),
    )


def _metadata(telemetry: Telemetry) -> list[Any]:
    """What AOT has no place of its own for, as keywords."""
    from aotpy import Metadatum

    dropped = int(telemetry.attributes["dropped_records"])
    return [
        Metadatum("ORIGIN", "faintspot"),
        Metadatum("DROPPED", dropped, "frames measured, lost by the recorder"),
        Metadatum("ARMS", ", ".join(telemetry.attributes["arms"]), "interleaved settings"),
        *(Metadatum(f"CHG{i}", json.dumps(each)) for i, each in enumerate(telemetry.changes, 1)),
    ]


def _sensor(telemetry: Telemetry, source: Any, estimator: str | None) -> Any:
    """The Shack-Hartmann sensor with its measurements."""
    import aotpy

    attributes = telemetry.attributes
    layout = attributes["layout"]
    window, corners = layout["window"], np.array(layout["corners"])
    when = aotpy.Time(
        "FRAMES", timestamps=telemetry.unix_time_s.tolist(), frame_numbers=telemetry.frame.tolist()
    )
    slopes = np.stack([telemetry.x, telemetry.y], axis=1)
    subtracted = aotpy.Metadatum("REFSUB", True, "reference has been subtracted already")
    summed = aotpy.Metadatum("FLUXSUM", True, "sum over the sub-aperture after background")
    middle = corners[:, ::-1] + 0.5 * (np.array(window[::-1]) - 1)
    taken_off = attributes.get("reference")
    reference = (np.array(layout["centres"]) - middle).T
    if taken_off is not None:
        reference = reference + np.reshape(taken_off, reference.shape)
    exact = [
        aotpy.Metadatum("LAYOUT", json.dumps(layout), "as faintspot has it"),
        aotpy.Metadatum("PARTS", json.dumps(attributes.get("parts")), "calibration, PSF, score"),
        aotpy.Metadatum("SUBTRACT", json.dumps(taken_off), "slopes that were subtracted, px"),
    ]
    sensor = aotpy.ShackHartmann(
        uid="SENSOR",
        source=source,
        n_valid_subapertures=len(corners),
        measurements=aotpy.Image("SLOPES", slopes, "pix", when, [subtracted]),
        ref_measurements=aotpy.Image("REFERENCE", reference.astype(np.float32), "pix", metadata=exact),
        subaperture_intensities=aotpy.Image("FLUX", telemetry.flux, "electron", when, [summed]),
        # AOT knows square sub-apertures only.
        subaperture_size=float(window[0]) if window[0] == window[1] else None,
        mask_offsets=[aotpy.Coordinates(float(corners[:, 1].min()), float(corners[:, 0].min()))],
        centroiding_algorithm=estimator,
        detector=_detector(telemetry),
    )
    mask = _mask(np.array(layout["cells"]))
    if mask is not None:
        sensor.subaperture_mask = aotpy.Image("SUBAPERTURES", mask)
    return sensor


def _mask(cells: NDArray[np.int64]) -> NDArray[np.int32] | None:
    """Square grid with the number of each sub-aperture, -1 elsewhere; None where two share a cell."""
    places = cells - cells.min(axis=0)
    mask = np.full((int(places.max()) + 1,) * 2, -1, np.int32)
    mask[places[:, 0], places[:, 1]] = np.arange(len(places))
    return mask if np.count_nonzero(mask >= 0) == len(places) else None


def _detector(telemetry: Telemetry) -> Any:
    """The detector, with the frames that were recorded."""
    import aotpy

    detector = aotpy.Detector(uid="DETECTOR")
    if len(telemetry.image_frame):
        numbers, places = np.unique(telemetry.frame, return_index=True)
        found = np.minimum(np.searchsorted(numbers, telemetry.image_frame), len(numbers) - 1)
        known = bool(np.all(numbers[found] == telemetry.image_frame))
        times = telemetry.unix_time_s[places[found]].tolist() if known else []  # all of them, or none
        when = aotpy.Time("IMAGES", timestamps=times, frame_numbers=telemetry.image_frame.tolist())
        detector.pixel_intensities = aotpy.Image("PIXELS", telemetry.raw, "adu", when)
    return detector
