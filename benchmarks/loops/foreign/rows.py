"""Rows of the table: loops of OOPAO, SPECULA, HCIPy and soapy."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from benchmarks.loops.foreign.base import ForeignLoop
from benchmarks.loops.foreign.oopao import ChangingLoop, OopaoCase, OopaoLoop

_MODULES = {"oopao": "OOPAO", "specula": "specula", "hcipy": "hcipy", "soapy": "soapy"}
TOOLS = tuple(_MODULES)


@dataclass(frozen=True)
class Row:
    """A loop, and the Strehl ratio that the filter should have."""

    name: str
    title: str
    make: Callable[[Path, float], ForeignLoop]
    """Takes the folder of the turbulence and a factor on the flux."""
    goal: float | None = None
    turned: bool = False
    """Whether the winds reverse after learning."""
    changed: bool = False
    """Whether the winds change after learning, and the control learns again in the background."""

    @property
    def tool(self) -> str:
        """Package that simulates it."""
        return self.name.partition("-")[0]


def _oopao(case: OopaoCase, folder: Path, brightness: float) -> ForeignLoop:
    brighter = replace(case, name=f"{case.name}x{brightness:g}", flux_e=case.flux_e * brightness)
    return OopaoLoop(case if brightness == 1 else brighter, folder)


def _changing(folder: Path, brightness: float) -> ForeignLoop:
    return ChangingLoop(replace(_FIRST, flux_e=_FIRST.flux_e * brightness), folder)


def _pyramid(tool: str, case: OopaoCase, folder: Path, brightness: float) -> ForeignLoop:
    case = replace(case, flux_e=case.flux_e * brightness)
    if tool == "specula":
        from benchmarks.loops.foreign.specula_pyramid import SpeculaPyramidLoop

        return SpeculaPyramidLoop(case, folder)
    if tool == "hcipy":
        from benchmarks.loops.foreign.hcipy_pyramid import HcipyPyramidLoop

        return HcipyPyramidLoop(case, folder)
    from benchmarks.loops.foreign.oopao_pyramid import PyramidLoop

    return PyramidLoop(case, folder)


def _specula(flux_e: float, own_slopes: bool, folder: Path, brightness: float) -> ForeignLoop:
    from benchmarks.loops.foreign.specula import SpeculaLoop

    return SpeculaLoop(flux_e * brightness, own_slopes=own_slopes, folder=folder)


def _hcipy(folder: Path, brightness: float) -> ForeignLoop:
    from benchmarks.loops.foreign.hcipy import HcipyLoop

    return HcipyLoop(40.0 * brightness, folder)


def _soapy(folder: Path, brightness: float) -> ForeignLoop:
    from benchmarks.loops.foreign.soapy import SoapyLoop

    return SoapyLoop(40.0 * brightness, folder)


_FIRST = OopaoCase("first")
_BRIGHT = OopaoCase("bright", flux_e=1e5, read_noise_e=0.5)
_PYRAMIDS = (
    ("", "100,000 e- a frame", _BRIGHT),
    ("-faint", "300 e- a frame", replace(_BRIGHT, name="faint", flux_e=300.0)),
    (
        "-vibration",
        "10,000 e- a frame, a tip of 45 Hz, 120 nm rms",
        replace(_BRIGHT, name="vibration", flux_e=1e4, vibration_nm=120.0),
    ),
)
_MOVED, _DEAD, _COLUMNS = (OopaoCase(fault, fault=fault) for fault in ("moved", "dead", "columns"))
_LARGE = OopaoCase("large", lenslets=16, lenslet_px=6, diameter_m=8.0, rate_hz=500.0)
ROWS = (
    Row("oopao-20", "r0 0.25 m, 20 e-, 3 e- read noise", partial(_oopao, _FIRST), 0.73),
    Row("oopao-60", "r0 0.15 m, 60 e-, 3 e-", partial(_oopao, OopaoCase("60", 0.15, 60.0, 3.0, 4.0)), 0.60),
    Row("oopao-200", "r0 0.25 m, 200 e-, 1 e-", partial(_oopao, OopaoCase("200", 0.25, 200.0, 1.0)), 0.835),
    Row(
        "oopao-vibration",
        "the first with a tip of 45 Hz, 120 nm rms",
        partial(_oopao, OopaoCase("vibration", vibration_nm=120.0)),
        0.71,
    ),
    Row(
        "oopao-delay3", "the first, delay of 3 frames", partial(_oopao, OopaoCase("3", delay_frames=3)), 0.70
    ),
    Row("oopao-delay1", "the first, delay of 1 frame", partial(_oopao, OopaoCase("1", delay_frames=1))),
    Row(
        "oopao-moved",
        "the first, mirror moved by 0.3 sub-apertures, 5 degrees",
        partial(_oopao, _MOVED),
        0.68,
    ),
    Row("oopao-dead", "the first, a dead actuator", partial(_oopao, _DEAD), 0.70),
    Row("oopao-columns", "the first, gains of commands 0.5 to 1.5", partial(_oopao, _COLUMNS), 0.70),
    Row("oopao-turned", "the first, winds reversed after learning", partial(_oopao, _FIRST), turned=True),
    Row("oopao-changed", "the first, other winds after learning", _changing, changed=True),
    Row("specula-40", "27 Zernikes, three winds, 40 e-", partial(_specula, 40.0, False), 0.70),
    Row("specula-20", "27 Zernikes, three winds, 20 e-", partial(_specula, 20.0, False), 0.65),
    Row("specula-own", "40 e-, SPECULA's own slopes", partial(_specula, 40.0, True), 0.725),
    Row("hcipy-40", "three of its layers, 40 e-, 1 e-", _hcipy),
    Row("soapy-40", "three of its infinite screens, 40 e-, 1 e-", _soapy),
    Row("oopao-modes", "the first, no geometry told", partial(_oopao, replace(_FIRST, is_modal=True))),
    Row(
        "oopao-modes-vibration",
        "the same with a tip of 45 Hz, 120 nm rms",
        partial(_oopao, OopaoCase("vibration", vibration_nm=120.0, is_modal=True)),
        0.605,
    ),
    Row("oopao-large", "8 m, 16 x 16, 500 Hz, r0 0.25 m, 20 e-, 3 e-", partial(_oopao, _LARGE)),
    *(
        Row(f"{tool}-pyramid{suffix}", f"a pyramid, {title}", partial(_pyramid, tool, case))
        for tool in ("oopao", "specula", "hcipy")
        for suffix, title, case in _PYRAMIDS
    ),
)


def chosen_rows(tool: str | None, names: tuple[str, ...]) -> list[Row]:
    """Return rows of a package, or with some names; all by default."""
    rows = [row for row in ROWS if (tool is None or row.tool == tool) and (not names or row.name in names)]
    return sorted(rows, key=lambda row: names.index(row.name)) if names else rows


def is_installed(tool: str) -> bool:
    """Return whether a package is there."""
    return importlib.util.find_spec(_MODULES[tool]) is not None
