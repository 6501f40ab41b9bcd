"""Requests that an engine and its telescope refuse: the fields of each, and what the error names."""

from collections.abc import Callable, Iterator
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from tests.refusals import assert_all_refused, refusal

from faintspot.engine.processes.requests import socket_path
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.loop.control.configuration import Control
from faintspot.loop.simulation.configuration import load_loop

Fields = dict[str, Any]
REQUESTS: list[tuple[str, Fields, tuple[str, ...]]] = [
    ("set", {}, ("changes",)),
    ("set", {"changes": [1]}, ("changes",)),
    ("set", {"changes": {}}, ("changes",)),
    ("set", {"changes": {"nois_std": 1}}, ("nois_std", "noise_std")),
    ("set", {"changes": {"noise_std": -1}}, ("noise_std = -1",)),
    ("set", {"changes": {"tolerance": 0.5, "noise_std": "much"}}, ("noise_std", "much")),
    ("set", {"changes": {"keep_brightest": 64}}, ("keep_brightest = 64",)),
    ("set", {"changes": {"search_range_px": np.nan}}, ("search_range_px", "NaN")),
    ("set", {"changes": {"estimator": "ml"}}, ("psf",)),
    ("set", {"changes": {"threshold_e": [1.0, 2.0]}}, ("threshold_e", "'thresholded'", "'tv'")),
    ("set", {"changes": {"flux_e": [1.0, 2.0]}}, ("flux_e", "16", "2")),  # not in use now, but it would stay
    ("set", {"changes": {"noise_std": 1}, "where": []}, ("where",)),
    ("set", {"changes": {"noise_std": 1}, "where": {"a": 1}}, ("where",)),
    ("set", {"changes": {"threshold_e": 1}, "where": [16]}, ("where", "sub-aperture 16")),
    ("set", {"changes": {"noise_std": "auto"}, "where": [0]}, ("noise_std",)),
    ("get", {"names": ["rules"]}, ("rules", "rule")),
    ("get", {"names": "rule"}, ("names = 'rule'",)),
    ("get", {"names": 3}, ("names = 3",)),
    ("get", {"names": [1]}, ("settings.1",)),
    ("get", {"names": ["spot_fwhm"]}, ("spot_fwhm",)),
    ("interleave", {}, ("methods = None",)),
    ("interleave", {"methods": "set", "every": 0}, ("every = 0",)),
    ("interleave", {"methods": "set,tvv"}, ("'tvv'",)),
    ("interleave", {"methods": "set,search_range_px=-1"}, ("search_range_px = -1",)),
    ("load", {}, ("source = None",)),
    ("unload", {"estimator": "tv"}, ("'tv'",)),
    ("loop", {}, ("action = None", "status", "flat")),
    ("loop", {"action": "shut"}, ("action = 'shut'",)),
    ("loop", {"action": "gain", "gain": -1}, ("gain = -1", "0 to 2")),
    ("loop", {"action": "gain"}, ("gain",)),
    ("spots", {"spots": "/none.toml"}, ("spots",)),  # its pipelines are not made from files
    ("learnt", {}, ("found = None",)),
    ("learnt", {"found": "x", "model": "x"}, ("controller", "kalman")),
]
METHODS: list[tuple[str, tuple[str, ...]]] = [
    ("", ()),
    ("tvv", ("'tvv'",)),
    ("none,,tv", ()),
    ("strength=2", ("strength",)),
    ("noise_std=", ("noise_std=",)),
    ("tv:", ("noise_std=",)),
    ("kalmann", ("'kalmann'",)),
    ("tv+", ("'tv+'", "NAME=VALUE")),
    ("tv+none", ("'tv+none'", "NAME=VALUE")),
    ("tv+kalman+tv", ("'kalman'",)),
    ("ml:2", ("'ml:2'",)),
]
NAMES = [(name, ("name",)) for name in ("", "a/b", "../x", ".x", "a b", "x" * 65, "é", None)]
CONDITIONS: list[tuple[Fields, tuple[str, ...]]] = [
    ({"photons": -1}, ("photons = -1",)),
    ({"photons": None}, ("photons",)),
    ({"magnitude": "bright"}, ("magnitude",)),
    ({"magnitude": -30}, ("photons = ",)),
    ({"photons": 1, "magnitude": 1}, ("photons", "magnitude")),
    ({"r0_m": 0}, ("r0_m",)),
    ({"r0_m": [0.1, 0.2, 0.3]}, ("r0_m", "0.1", "0.3")),
    ({"phtons": 1}, ("phtons", "photons")),
]


def ordered(changes: Fields) -> object:
    """Order conditions of a simulated telescope, of which one is right."""
    from faintspot.engine.telescope import ObservingConditions

    loop = load_loop("canary")
    return ObservingConditions.of(loop).ordered(loop, {"wind_factor": 3.0, **changes})


@pytest.mark.parametrize(
    ("ask", "rows"), [(Interleaving.parse, METHODS), (socket_path, NAMES), (ordered, CONDITIONS)]
)
def test_arguments_that_are_refused(ask: Callable[[Any], object], rows: list[Any]) -> None:
    assert_all_refused(rows, lambda given: refusal(lambda: ask(given)))


@pytest.fixture(scope="module")
def engine() -> Iterator[Any]:
    """An engine with a loop, whose settings are those of `tests.engine.bench`."""
    pytest.importorskip("pyshmem")
    from tests.engine.bench import LAYOUT, Bench

    matrix = np.random.default_rng(1).standard_normal((2 * len(LAYOUT), 5))
    with Bench(f"fs_test_{uuid4().hex[:12]}", control=Control(matrix)) as bench:
        yield bench.engine


def test_requests_that_are_refused(engine: Any) -> None:
    """The settings stay, and those that were refused are counted."""
    commands, before = commands_of(engine), engine.live.newest
    rows = (((command, fields), names) for command, fields, names in REQUESTS)
    assert_all_refused(rows, lambda given: refusal(lambda: commands[given[0]](dict(given[1]))))
    assert engine.live.newest is before
    assert engine.live.taken() == []
    assert engine.counters.settings_refused == sum(command == "set" for command, *_ in REQUESTS)
