"""Protocol of alternating observations, and a night: one row for each block of frames of one method."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.files import NpzFile
from faintspot.base.options import LIST, TEXTS, Options, number, setting
from faintspot.experiments.closed_loop.results import with_choice
from faintspot.loop.control.base import INTEGRATOR
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import UNCORRECTED, Method
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.settings import Settings

NONE, TV = "none", TotalVariation.name
"""Names of the paper's methods: without TV, and with TV at every strength."""
PAPER_METHODS = NONE, TV
BEST_STRENGTHS = 0.6, 1.1
"""Strengths of which the paper's Table 1 has a column of its own, ends included."""
ELECTRONS, COUNTS = "e-", "counts"
"""Units of the strength, which the paper does not state: photo-electrons, and counts of the camera."""


@dataclass(frozen=True)
class NightPlan(Options, table="plan"):
    """Schedule of a night; its default is that of the paper.

    The paper's four sets took a little more than an hour, each with its cycle repeated once; the exposure
    time is not stated. Here a block begins every 31 s, which makes 62 minutes at 150 frames/s, and 5 s of it
    are exposed.

    Parameters
    ----------
    block_frames : int
        Frames that one method measures in a cycle.
    settle_in_block : int
        Of these, those at the beginning that are not scored.
    gap_frames : int
        Frames between two blocks, in which a telescope stores its data; they are not simulated.
    strengths : tuple of int
        Number of strengths of TV in each set, evenly spaced from 0 to `strongest`.
    em_fractions : tuple of float
        Multiplication gain in each set, as a fraction of the configuration's.
    repeats : tuple of int
        Cycles of each set.
    strongest : float
        Largest strength.
    unit : str
        Unit of strengths: "e-", or "counts" of the camera at the gain of each set.
    methods : tuple of str
        Methods of a cycle; the first is the reference. "none": brightest pixels; "tv": all strengths; others
        as in `Method.named`, with the integrator.
    listed_strengths : tuple of float
        Strengths of all sets instead of evenly spaced ones.
    keep_brightest : int
        Pixels kept without and with TV: those of the paper's simulations.

    Raises
    ------
    InputError
        For numbers out of range, lists of different lengths or unsuitable methods.
    """

    block_frames: int = number(830, 1, 10**6, whole=True)
    settle_in_block: int = number(80, 0, 10**6, whole=True)
    gap_frames: int = number(3820, 0, 10**6, whole=True)
    strengths: tuple[int, ...] = number((8, 20, 8, 20), 2, 100, kind=LIST, whole=True)
    em_fractions: tuple[float, ...] = number((1.0, 1.0, 0.75, 0.75), 0, 1, kind=LIST, low_open=True)
    repeats: tuple[int, ...] = number((2, 2, 2, 2), 1, 10**4, kind=LIST, whole=True)
    strongest: float = number(2.0, 0, 1e6, low_open=True)
    unit: str = setting(ELECTRONS, choices=(ELECTRONS, COUNTS))
    methods: tuple[str, ...] = setting(PAPER_METHODS, kind=TEXTS)
    listed_strengths: tuple[float, ...] = number((), 0, 1e6, kind=LIST)
    keep_brightest: int = number(40, 1, 10**6, whole=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        number_between("plan.block_frames", self.block_frames, self.settle_in_block + 20)
        if not len(self.strengths) == len(self.em_fractions) == len(self.repeats) >= 1:
            raise InputError("plan: expected strengths, em_fractions and repeats for each set")
        if len(self.methods) < 2 or len(set(self.methods)) < len(self.methods):
            raise InputError(f"methods: expected two or more different ones, got {', '.join(self.methods)}")
        for name in self.methods:
            if kind_of(name).control != INTEGRATOR:
                raise InputError(
                    f"method = {name!r}: expected the integrator, which alternating methods share"
                )

    @property
    def sets(self) -> int:
        """Number of sets."""
        return len(self.strengths)

    def entries(self, number: int) -> list[tuple[str, float]]:
        """Return method and strength (NaN: none) of each block of a cycle, for a set counted from 0."""
        rising = self.listed_strengths or np.linspace(0, self.strongest, self.strengths[number]).tolist()
        return [
            (name, float(strength))
            for name in self.methods
            for strength in (rising if name == TV else [math.nan])
        ]

    def blocks(self, number: int) -> int:
        """Return the number of blocks of a set."""
        return len(self.entries(number)) * self.repeats[number]

    def frames(self, number: int) -> int:
        """Return the number of simulated frames of a set."""
        return self.blocks(number) * self.block_frames

    def schedule(self, number: int) -> NDArray[np.int64]:
        """Return which entry of the cycle measures each frame of a set, (frames,)."""
        block = np.arange(self.frames(number)) // self.block_frames
        return np.asarray(block % len(self.entries(number)), np.int64)

    def first_frames(self, number: int) -> NDArray[np.int64]:
        """Return the first frame of each block of a set, from the beginning of the night, (blocks,)."""
        before = sum(self.blocks(each) for each in range(number))
        return (before + np.arange(self.blocks(number))) * (self.block_frames + self.gap_frames)

    def frame_numbers(self, number: int) -> NDArray[np.int64]:
        """Return the number of each frame of a set, from the beginning of the night, (frames,)."""
        return (self.first_frames(number)[:, None] + np.arange(self.block_frames)).ravel()

    def set_name(self, number: int) -> str:
        """Return multiplication gain and strengths of a set in words."""
        fraction = self.em_fractions[number]
        strengths = self.listed_strengths or range(self.strengths[number])
        gain = "full gain" if fraction == 1 else f"{fraction * 100:g} % of the gain"
        return f"{gain}, {len(strengths)} strengths" if TV in self.methods else gain

    def configuration(self, configuration: LoopConfiguration, number: int) -> LoopConfiguration:
        """Return the configuration of a set, with its multiplication gain and number of frames."""
        gain = max(1.0, self.em_fractions[number] * configuration.camera.em_gain)
        run = {"frames": self.frames(number), "settle_frames": self.settle_in_block}
        return configuration.replace("camera", em_gain=gain).replace("run", **run)

    def made(self, configuration: LoopConfiguration, number: int) -> list[Method]:
        """Return the methods of a set's cycle, in order; sets are counted from 0."""
        return [self._method(configuration, name, strength) for name, strength in self.entries(number)]

    def _method(self, configuration: LoopConfiguration, name: str, strength: float) -> Method:
        label = label_of(name, strength, self.unit)
        if name not in PAPER_METHODS:
            return replace(with_choice(kind_of(name), configuration, None), label=label)
        estimator: Estimator = BrightestPixels(keep_brightest=self.keep_brightest)
        if name == TV:
            noise_std = strength / (1.0 if self.unit == ELECTRONS else counts_per_e(configuration))
            estimator = TotalVariation(keep_brightest=self.keep_brightest, noise_std=noise_std)
        # At a telescope all strengths share the command matrix; centroid gains are not measured for each.
        return Method(label, Settings(estimator), variants=(UNCORRECTED,))


def counts_per_e(configuration: LoopConfiguration) -> float:
    """Return the counts of the camera for one photo-electron."""
    return configuration.camera.em_gain / configuration.camera.gain_e_per_adu


def kind_of(name: str) -> Method:
    """Return a method by its name; "none" is brightest pixels alone."""
    return Method.named(BrightestPixels.name if name == NONE else name)


def label_of(name: str, strength: float, unit: str = ELECTRONS) -> str:
    """Return the label of a method."""
    if name == NONE:
        return "no TV"
    return f"TV {strength:.3g} {unit}" if name == TV else kind_of(name).label


QUICK_PLAN = NightPlan(
    block_frames=150, settle_in_block=60, gap_frames=4500, strengths=(4, 6, 4, 6), repeats=(2, 2, 2, 2)
)


NIGHT_FILE = "night.npz"
"""Name of the file in a folder of results."""


@dataclass(frozen=True, eq=False)
class Night(NpzFile):
    """Blocks of a night in the order of time; arrays are (B,) unless stated otherwise. NaN: not known.

    A block is a stretch of frames that one method measured, without the frames in which the loop settled.
    Sets are stretches of the night with the same conditions, such as the multiplication gain of the camera.
    """

    WHAT: ClassVar[str] = "a night"
    FORMAT: ClassVar[int] = 2
    OPTIONAL: ClassVar[tuple[str, ...]] = ("counts_per_e", "shared_error")

    labels: tuple[str, ...]
    """(M,): names of the methods."""
    settings: tuple[str, ...]
    """(M,): settings of each method in words, loop gain included."""
    reference: int
    """Number of the method that the others are compared with."""
    set_names: tuple[str, ...]
    """(S,)"""
    set_number: NDArray[np.int64]
    """Index into set_names."""
    method: NDArray[np.int64]
    """Index into labels."""
    strength: Floats
    """Strength of TV in `strength_unit`; NaN for methods without one."""
    start_s: Floats
    """First scored frame of the block, from the beginning of the night."""
    duration_s: Floats
    """Duration of the scored frames."""
    strehl: Floats
    """Long-exposure Strehl ratio of the block."""
    strehl_error: Floats
    """Standard error of `strehl` by measurement alone, without what the turbulence adds between blocks."""
    phase_rad2: Floats
    """Residual phase variance at the science wavelength, mean over the block."""
    phase_error_rad2: Floats
    """Standard error of `phase_rad2`, as for `strehl_error`."""
    r0_m: Floats
    """Fried parameter at 500 nm, measured from pseudo-open-loop slopes of the block."""
    r0_error_m: Floats
    true_r0_m: Floats
    """Fried parameter at 500 nm in a simulation."""
    paired_strehl: Floats
    """Strehl ratio of the reference in the same turbulence at the same time, in a simulation."""
    overhead_s: float
    """Time lost for each block by changing the method and settling."""
    wavelength_m: float
    """Science wavelength of Strehl ratio and phase."""
    source: str
    """Source of the blocks: "simulated" or a file."""
    configuration: str
    """TOML text of the simulated configuration, or ""."""
    strength_unit: str = "e-"
    """"e-": photo-electrons, or "counts" of the camera."""
    counts_per_e: Floats | None = None
    """Counts of the camera for a photo-electron, where they are known."""
    shared_error: Floats | None = None
    """Standard error of `strehl`, against that of the reference, that blocks of a method have in common."""

    def __post_init__(self) -> None:
        count = len(self.start_s)
        for name, value in self._arrays().items():
            if value.shape != (count,):
                raise InputError(f"{name}: expected a value for each of {count} blocks, got {value.shape}")
        for name, numbers, limit in (
            ("method", self.method, len(self.labels)),
            ("set_number", self.set_number, len(self.set_names)),
        ):
            if count and not (numbers.min() >= 0 and numbers.max() < limit):
                raise InputError(f"{name}: expected numbers from 0 to {limit - 1}")
        if not 0 <= self.reference < len(self.labels):
            raise InputError(f"reference: expected 0 to {len(self.labels) - 1}, got {self.reference}")

    @property
    def middle_s(self) -> Floats:
        """(B,): middle of each block, from the beginning of the night."""
        return self.start_s + self.duration_s / 2

    @property
    def hours(self) -> float:
        """Duration of the observations, settling included."""
        return float((self.duration_s + self.overhead_s).sum()) / 3600

    @property
    def is_reference(self) -> NDArray[np.bool_]:
        """(B,): whether the reference measured a block."""
        return np.equal(self.method, self.reference)

    @property
    def sets(self) -> list[NDArray[np.bool_]]:
        """(B,) for each set: its blocks."""
        return [self.set_number == number for number in range(len(self.set_names))]

    def strengths_within(self, low: float, high: float) -> NDArray[np.bool_]:
        """Return the blocks with strengths in a range, ends included, (B,)."""
        return (self.strength >= low) & (self.strength <= high)

    @property
    def has_strengths(self) -> bool:
        """Whether there are blocks with TV."""
        return bool((self.strength > 0).any())

    @property
    def is_paired(self) -> bool:
        """Whether the reference is known in the same turbulence."""
        return bool(np.isfinite(self.paired_strehl).any())

    @property
    def cycle(self) -> NDArray[np.int64]:
        """(B,): number of the cycle, which begins with each block of the reference and each set."""
        new_set = np.diff(self.set_number, prepend=self.set_number[:1] - 1) != 0
        return np.cumsum(new_set | self.is_reference) - 1

    def _arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
