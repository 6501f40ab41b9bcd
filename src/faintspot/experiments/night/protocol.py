"""Protocol of the paper's observations: sets of cycles, each without TV and then with rising strengths."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import number_between
from faintspot.base.config.options import LIST, TEXTS, Options, number, setting
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.methods import LOOP_GAIN, with_choice
from faintspot.experiments.methods import Choice
from faintspot.loop.control.base import INTEGRATOR
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.settings import Settings

NONE, TV = "none", TotalVariation.name
"""Names of the paper's methods: without TV, and with TV at every strength."""
PAPER_METHODS = NONE, TV
BEST_STRENGTHS_E = 0.6, 1.1
"""Strengths of which the paper's Table 1 has a column of its own, ends included."""
PAPER_MEANS = np.full((4, 3), np.nan)
"""Table 1 of the paper: mean Strehl ratio of each set without TV, with TV, and with `BEST_STRENGTHS_E`.

NaN: the numbers could not be looked up; they are not guessed.
"""

_KEPT_OPTION, _STRENGTH_OPTION = "keep_brightest", "noise_std"


@dataclass(frozen=True)
class NightPlan(Options, table="plan"):
    """Schedule of a night.

    Parameters
    ----------
    block_frames : int
        Frames that one method measures in a cycle.
    settle_in_block : int
        Of these, those at the beginning that are not scored.
    strengths : tuple of int
        Number of strengths of TV in each set, evenly spaced from 0 to `strongest_e`.
    em_fractions : tuple of float
        Multiplication gain in each set, as a fraction of the configuration's.
    repeats : tuple of int
        Cycles of each set.
    strongest_e : float
        Largest strength [e-].
    methods : tuple of str
        Methods of a cycle; the first is the reference. "none": brightest pixels; "tv": all strengths; others
        as in `Method.named`, with the integrator.
    strengths_e : tuple of float
        Strengths of all sets instead of evenly spaced ones [e-].
    strength_factors : tuple of float
        Factor on the strength in each sub-aperture; empty: 1.
    keep_brightest : int
        Pixels kept where nothing is tuned: those of the paper's simulations.

    Raises
    ------
    InputError
        For numbers out of range, lists of different lengths or unsuitable methods.
    """

    block_frames: int = number(600, 1, 10**6, whole=True)
    settle_in_block: int = number(100, 0, 10**6, whole=True)
    strengths: tuple[int, ...] = number((8, 20, 8, 20), 2, 100, kind=LIST, whole=True)
    em_fractions: tuple[float, ...] = number((1.0, 1.0, 0.75, 0.75), 0, 1, kind=LIST, low_open=True)
    repeats: tuple[int, ...] = number((4, 2, 4, 2), 1, 10**4, kind=LIST, whole=True)
    strongest_e: float = number(2.0, 0, 1e6, low_open=True)
    methods: tuple[str, ...] = setting(PAPER_METHODS, kind=TEXTS)
    strengths_e: tuple[float, ...] = number((), 0, 1e6, kind=LIST)
    strength_factors: tuple[float, ...] = number((), 0, 1e6, kind=LIST)
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
        rising = self.strengths_e or np.linspace(0, self.strongest_e, self.strengths[number]).tolist()
        return [
            (name, float(strength))
            for name in self.methods
            for strength in (rising if name == TV else [math.nan])
        ]

    def blocks(self, number: int) -> int:
        """Return the number of blocks of a set."""
        return len(self.entries(number)) * self.repeats[number]

    def frames(self, number: int) -> int:
        """Return the number of frames of a set."""
        return self.blocks(number) * self.block_frames

    def schedule(self, number: int) -> NDArray[np.int64]:
        """Return which entry of the cycle measures each frame of a set, (frames,)."""
        block = np.arange(self.frames(number)) // self.block_frames
        return np.asarray(block % len(self.entries(number)), np.int64)

    def first_frame(self, number: int) -> int:
        """Return the first frame of a set, from the beginning of the night."""
        return sum(self.frames(before) for before in range(number))

    def set_name(self, number: int) -> str:
        """Return multiplication gain and strengths of a set in words."""
        fraction, strengths = self.em_fractions[number], self.strengths_e or range(self.strengths[number])
        gain = "full gain" if fraction == 1 else f"{fraction * 100:g} % of the gain"
        return f"{gain}, {len(strengths)} strengths" if TV in self.methods else gain

    def configuration(self, configuration: LoopConfiguration, number: int) -> LoopConfiguration:
        """Return the configuration of a set, with its multiplication gain and number of frames."""
        gain = max(1.0, self.em_fractions[number] * configuration.camera.em_gain)
        run = {"frames": self.frames(number), "settle_frames": self.settle_in_block}
        return configuration.replace("camera", em_gain=gain).replace("run", **run)

    def made(
        self, configuration: LoopConfiguration, number: int, choices: Mapping[str, Choice]
    ) -> list[Method]:
        """Return the methods of a set's cycle, in order.

        Parameters
        ----------
        configuration : LoopConfiguration
        number : int
            Set, counted from 0.
        choices : mapping
            Tuned values by the method's name; empty where nothing is tuned.
        """
        return [
            self._method(configuration, name, strength, choices.get(name))
            for name, strength in self.entries(number)
        ]

    def _method(
        self, configuration: LoopConfiguration, name: str, strength_e: float, choice: Choice | None
    ) -> Method:
        label = label_of(name, strength_e)
        if name not in PAPER_METHODS:
            return replace(with_choice(kind_of(name), configuration, choice), label=label)
        values = dict(choice or {_KEPT_OPTION: self.keep_brightest})
        gain = values.pop(LOOP_GAIN, None)
        if name == NONE:
            return Method(label, Settings(BrightestPixels(**values)), gain)
        factors: Any = np.array(self.strength_factors or 1.0)
        values[_STRENGTH_OPTION] = strength_e * factors if self.strength_factors else strength_e
        return Method(label, Settings(TotalVariation(**values)), gain)


def kind_of(name: str) -> Method:
    """Return a method by its name; "none" is brightest pixels alone."""
    return Method.named(BrightestPixels.name if name == NONE else name)


def label_of(name: str, strength_e: float) -> str:
    """Return the label of a method."""
    if name == NONE:
        return "no TV"
    return f"TV {strength_e:.3g} e-" if name == TV else kind_of(name).label


QUICK_PLAN = NightPlan(block_frames=260, settle_in_block=60, strengths=(4, 6, 4, 6), repeats=(2, 1, 2, 1))
