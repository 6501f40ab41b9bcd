"""A loop as observatories and benches write it: each writer puts the same arrays into files of one layout."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tests.io import idl_file

RATE_HZ, START_S = 250.0, 1_700_000_000.0


class Loop(NamedTuple):
    """Slopes (all x, then all y), commands and matrix of a loop; `first` is the number of the first frame."""

    slopes: np.ndarray
    commands: np.ndarray
    matrix: np.ndarray
    mask: np.ndarray
    first: int = 7


def random_loop(frames: int = 40, side: int = 3, commands: int = 5) -> Loop:
    """Return numbers of a loop that is no loop, whose arrays differ everywhere."""
    rng = np.random.default_rng(6)
    slopes = rng.standard_normal((frames, 2 * side * side))
    matrix = rng.standard_normal((2 * side * side, commands))
    return Loop(slopes, rng.standard_normal((frames, commands)), matrix, np.ones((side, side)))


def pairs(array: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return x and y of each sub-aperture in turn."""
    halves = np.split(array, 2, axis=axis)
    return np.stack(halves, axis=axis % array.ndim + 1).reshape(array.shape)


def sparta(folder: Path, loop: Loop, control: bool = False, **header: Any) -> Path:
    """Write a table as CIAO's, the last two commands of the tip-tilt mirror, and matrices beside it."""
    from astropy.io import fits

    frames, n = len(loop.slopes), loop.commands.shape[1] - 2
    time_s = np.arange(frames) / RATE_HZ
    columns = [
        fits.Column("FrameCounter", "J", bzero=2**31, array=np.arange(frames, dtype=np.uint32) + loop.first),
        fits.Column("Seconds", "J", array=(START_S + np.floor(time_s)).astype(np.int32)),
        fits.Column("USeconds", "J", array=np.rint(1e6 * (time_s % 1)).astype(np.int32)),
        fits.Column("Gradients", f"{loop.slopes.shape[1]}D", array=pairs(loop.slopes)),
        fits.Column("HODM_Positions", f"{n}D", array=loop.commands[:, :n]),
        fits.Column("ITTM_Positions", "2D", array=loop.commands[:, n:]),
    ]
    primary = fits.PrimaryHDU()
    for name, value in header.items():
        primary.header[f"HIERARCH ESO AOS {name.replace('_', ' ')}"] = value
    table = fits.BinTableHDU.from_columns(columns, name="LoopFrame")
    fits.HDUList([primary, table]).writeto(folder / "CIAO_LOOP_0001.fits")
    matrix = pairs(loop.matrix, 0)
    if control:
        fits.writeto(folder / "Recn.REC1.CM_0001.fits", np.linalg.pinv(matrix))
        fits.writeto(folder / "RecnOptimiser.HO_IM_0001.fits", matrix[:, :n])
        fits.writeto(folder / "RecnOptimiser.HO_IM_0002.fits", np.zeros((3, 3)))
    else:
        fits.writeto(folder / "CLMatrixOptimiser.HO_IM.fits", matrix[:, :n])
        fits.writeto(folder / "CLMatrixOptimiser.ITT_IM.fits", matrix[:, n:].T)
    return folder / "CIAO_LOOP_0001.fits"


def keck(folder: Path, loop: Loop, name: str = "n0001_LGS_trs.sav") -> Path:
    """Write a save file of a tip-tilt loop; its commands are in the axes of the slopes."""
    ticks = (np.arange(len(loop.slopes)) / RATE_HZ * 1e7).astype(np.int64)
    fields = {"DTTCENTROIDS": loop.slopes, "DTTCOMMANDS": loop.commands, "TIMESTAMP": ticks}
    servo = np.array([0.3, 0, 0, 0, -0.99, 0, 0, 0], np.float32)
    return idl_file.write(folder / name, {"B": fields, "DT_SERVO": servo})


def keck_high_order(folder: Path, loop: Loop) -> Path:
    """Write a save file of both loops; the last two commands are tip and tilt, and the last row is focus."""
    frames, n = len(loop.slopes), loop.commands.shape[1] - 2
    ticks = (np.arange(frames) / RATE_HZ * 1e7).astype(np.int64)
    control = np.linalg.pinv(pairs(loop.matrix, 0))
    residual = np.hstack([np.zeros((frames, n)), loop.slopes[:, :2], np.zeros((frames, 1))])
    fields = {
        "OFFSETCENTROID": pairs(loop.slopes).astype(np.float32),
        "DMCOMMAND": loop.commands[:, :n].astype(np.float32),
        "TTCOMMANDS": loop.commands[:, n:].astype(np.float32),
        "RESIDUALWAVEFRONT": residual.astype(np.float32),
        "TIMESTAMP": ticks,
    }
    rx = np.vstack([control, np.zeros((1, control.shape[1]))])[None].astype(np.float32)
    variables = {"A": fields, "RX": rx, "NREC": np.int16(1), "DM_SERVO": np.ones(8, np.float32)}
    return idl_file.write(folder / "n0001_trs.sav", variables)


def milk(folder: Path, loop: Loop, cubes: int = 2, latency_s: float = 0.0007) -> Path:
    """Write streams of slopes and commands, in several cubes, as milk's logger does."""
    from astropy.io import fits

    time_s = START_S + np.arange(len(loop.slopes)) / RATE_HZ
    images = loop.slopes.reshape(len(loop.slopes), 2, -1)
    for stream, frames, delay_s in (("wfs", images, 0.0), ("dm", loop.commands[:, None], latency_s)):
        (folder / stream).mkdir()
        for rows in np.array_split(np.arange(len(frames)), cubes):
            sent = time_s[rows] + delay_s
            stamp = f"10:20:{sent[0] - START_S:012.9f}"
            fits.writeto(folder / stream / f"{stream}_{stamp}.fits", frames[rows].astype(np.float64))
            counter = rows + loop.first
            lines = [np.arange(len(rows)), counter, sent - sent[0], sent + 1e-4, sent, counter, 0 * rows]
            header = "Telemetry stream timing data\ncol1 : datacube frame index"
            kinds = ["%d", "%d", "%.9f", "%.9f", "%.6f", "%d", "%d"]
            target = folder / stream / f"{stream}_{stamp}.txt"
            np.savetxt(target, np.stack(lines, axis=1), header=header, fmt=kinds)
    return folder


def texts(folder: Path, loop: Loop) -> Path:
    """Write a folder of text files, as ciao names them."""
    x, y = np.split(loop.slopes, 2, axis=1)
    np.savetxt(folder / "x_slopes.txt", x)
    np.savetxt(folder / "y_slopes.csv", y, delimiter=",")
    np.savetxt(folder / "commands.txt", loop.commands)
    np.savetxt(folder / "poke.txt", loop.matrix)
    np.savetxt(folder / "reference_mask.txt", loop.mask)
    np.savetxt(folder / "time_s.txt", np.arange(len(x)) / RATE_HZ)
    return folder


WRITERS: dict[str, Callable[[Path, Loop], Path]] = {"sparta": sparta, "milk": milk, "texts": texts}
