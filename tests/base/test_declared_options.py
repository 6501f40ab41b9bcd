"""Every declared option of every table: what is outside its limits, NaN or of a wrong type is refused."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.base.options import FLAG, LIST, NUMBER_OR_LIST, TEXT, TEXTS, Option, Options
from faintspot.experiments import Question, StudySpecification, Sweep
from faintspot.experiments.night.protocol import NightPlan
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.settings import SharedOptions
from faintspot.slopes.recorded.measuring import Choices
from faintspot.slopes.simulate import Detector
from faintspot.slopes.simulate.photometry import Photometry
from faintspot.slopes.spots.laser_spots import LaserSpots

LOOP = LoopConfiguration()
SAMPLES: list[Options] = [
    *(kind(noise_std=1.0) if kind is TotalVariation else kind() for kind in estimators().values()),
    *(part for field in dataclasses.fields(LOOP) if isinstance(part := getattr(LOOP, field.name), Options)),
    SharedOptions(),
    ControlOptions(),
    Detector(),
    fs.Calibration(),
    fs.Layout.grid((2, 2), pixels=8),
    Choices(),
    NightPlan(),
    Photometry(area_m2=1.0, frame_time_s=1.0),
    LaserSpots(launch_m=(0.0, 0.0), spot_fwhm_arcsec=1.0),
    Question(read_noise_e=3.0, pixels=16, fwhm_px=2.0, flux_e=100.0),
    Method("a", fs.Settings("brightest")),
    StudySpecification("x", [Sweep("a")]),
]


def at_limits(option: Option) -> Iterator[float]:
    """Return the least and the largest number that a declaration allows."""
    if math.isfinite(option.low):
        yield float(np.nextafter(option.low, math.inf)) if option.low_open else option.low
    if math.isfinite(option.high):
        yield option.high


def wrong_numbers(option: Option) -> Iterator[float]:
    """Return numbers just outside the limits, and what is none."""
    if math.isfinite(option.low):
        yield option.low if option.low_open else float(np.nextafter(option.low, -math.inf))
    if math.isfinite(option.high):
        yield float(np.nextafter(option.high, math.inf))
    if option.whole:
        yield max(option.low, 0.0) + 1.5
    yield from (math.nan, math.inf, -math.inf)


def wrong_values(option: Option) -> Iterator[Any]:
    """Return values that a declaration does not allow."""
    if option.kind in (FLAG, TEXT):
        yield from (3.0, ["a"], "" if option.kind == TEXT else "yes", *(() if option.optional else (None,)))
    elif option.kind == TEXTS:
        yield from (3.0, [3.0], *([["neither"]] if option.choices else []))
    elif option.kind in (LIST, NUMBER_OR_LIST):
        yield from ([[number] for number in wrong_numbers(option)])
        yield from ("text", ["text"], *([1.0] if option.kind == LIST else []))
    elif option.choices:
        yield from ("neither", "", 3.0, {}, *(() if option.per_subaperture else ([option.choices[0]],)))
    else:
        yield from wrong_numbers(option)
        yield from ("text", True, 1j, [], {}, [[1.0, 1.0]])
        allowed = next(at_limits(option), 1.0)
        if option.per_subaperture:
            yield from ([allowed, number] for number in wrong_numbers(option))
        else:
            yield [allowed, allowed]
    if not (option.optional or option.kind):
        yield None


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: type(sample).__name__)
def test_values_that_the_declaration_excludes_are_refused_in_one_line_that_names_the_option(
    sample: Options,
) -> None:
    for name, option in sample.declared().items():
        if option.check is None:
            for value in wrong_values(option):
                with refused(name):
                    dataclasses.replace(sample, **{name: value})
                    pytest.fail(f"{name} = {value!r} is accepted")


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: type(sample).__name__)
def test_values_at_the_limits_are_kept(sample: Options) -> None:
    for name, option in sample.declared().items():
        if option.check is None and not option.kind:
            for value in (*option.choices, *([] if option.choices else at_limits(option))):
                assert option.checked(name, value) == value
            if option.per_subaperture and not option.choices:
                numbers = list(at_limits(option))
                assert not numbers or option.checked(name, numbers).tolist() == numbers


def test_no_table_is_left_out() -> None:
    def below(kind: type[Options]) -> Iterator[type[Options]]:
        for each in kind.__subclasses__():
            yield each
            yield from below(each)

    tables = {kind for kind in below(Options) if kind.__module__.startswith("faintspot.") and kind.declared()}
    known = {parent for sample in SAMPLES for parent in type(sample).__mro__}
    assert {kind for kind in tables - known if not any(issubclass(each, kind) for each in known)} == set()
