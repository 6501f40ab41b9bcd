"""Results of the closed-loop experiments, and the files that hold them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.files import parse_json, write_atomically
from faintspot.loop.files import INTERLEAVED_FILE, Stored, make_folder
from faintspot.loop.record import LoopRecord

Floats = NDArray[np.float64]
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class InterleavedResult:
    """Observations with and without denoising in turn, as on the sky; one item per set."""

    records: tuple[LoopRecord, ...]
    block: tuple[NDArray[np.int64], ...]
    """(frames,) each: number of the measurement that a frame belongs to."""
    strengths: tuple[Floats, ...]
    """(arms,) each: strength of the denoising, electrons; NaN: none."""
    set_names: tuple[str, ...]
    settle_in_block: int
    """Frames at the start of every measurement that are not scored."""

    def save(self, folder: str | Path) -> None:
        """Write the sets and what they are to a folder, which is made.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        folder = make_folder(folder)
        for number, record in enumerate(self.records, start=1):
            record.save(set_file(folder, number))
        self.save_description(folder)

    def save_description(self, folder: Path) -> None:
        """Write what the sets are, where their records are written already.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        sets = [
            {
                "name": name,
                "strengths_e": [None if math.isnan(strength) else float(strength) for strength in strengths],
                "block_frames": np.bincount(block).tolist(),
            }
            for name, strengths, block in zip(self.set_names, self.strengths, self.block, strict=True)
        ]
        document = {"format": _FORMAT, "settle_in_block": self.settle_in_block, "sets": sets}
        write_atomically(folder / INTERLEAVED_FILE, json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, folder: str | Path) -> InterleavedResult:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            When it cannot be read, or is something else.
        """
        folder = Path(folder)
        path = folder / INTERLEAVED_FILE
        try:
            document: Any = parse_json(path.read_text(encoding="utf-8"))
            sets = document["sets"]
            if document["format"] != _FORMAT:
                raise ValueError(f"format {document['format']}")
            strengths = [
                np.array([math.nan if value is None else value for value in each["strengths_e"]], np.float64)
                for each in sets
            ]
            block = [np.repeat(np.arange(len(each["block_frames"])), each["block_frames"]) for each in sets]
            names = tuple(str(each["name"]) for each in sets)
            settle = int(document["settle_in_block"])
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not the result of interleaved observations ({error})") from None
        records = tuple(LoopRecord.load(set_file(folder, number)) for number in range(1, len(sets) + 1))
        return cls(records, tuple(block), tuple(strengths), names, settle)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(Stored):
    """Strehl ratio against the star's light: A arms, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 3

    names: tuple[str, ...]
    """(A,): of the arms, see `faintspot.loop.arm_kinds.arm_kind`."""
    labels: tuple[str, ...]
    """(A,)"""
    photons: Floats
    """(F,): photo-electrons of a fully lit sub-aperture in a frame."""
    magnitudes: Floats
    """(F,)"""
    strehl: Floats
    """(A, F, R): long exposure; NaN where not measured yet."""
    centroid_gain: Floats
    """(A, F, R)"""
    settings: NDArray[np.str_]
    """(A, F): TOML text of the tuned settings; "" where not tuned yet."""
    choices: NDArray[np.str_]
    """(A, F): JSON text of the tuned values, loop gain included; "{}" where not tuned yet."""
    psf: NDArray[np.float32]
    """(A, F, p, p): long-exposure image, mean over realisations; 1 at the peak of a flat wavefront's."""
    configuration: str
    """TOML text."""


@dataclass(frozen=True, eq=False)
class BudgetResult(Stored):
    """Error budget: A arms with T terms switched off, R realisations of the air."""

    WHAT: ClassVar[str] = "an error budget"
    FORMAT: ClassVar[int] = 2

    names: tuple[str, ...]
    """(A,): of the arms, see `faintspot.loop.arm_kinds.arm_kind`."""
    terms: tuple[str, ...]
    """(T,): what is switched off; the first is nothing."""
    labels: tuple[str, ...]
    """(A,)"""
    strehl: Floats
    """(A, T, R): long exposure; NaN where not measured yet."""
    residual_nm: Floats
    """(A, T, R): rms of the wavefront after the mirror, root of the mean square over the frames."""


def set_file(folder: Path, number: int) -> Path:
    """Return where the record of a set is, counted from 1."""
    return folder / f"set-{number}.npz"
