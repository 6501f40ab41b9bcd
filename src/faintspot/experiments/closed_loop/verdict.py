"""Tables, sentences and the report page of closed-loop results."""

import textwrap
import tomllib

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report import page
from faintspot.base.report.plots import Line, Panel
from faintspot.base.report.texts import Texts, plain_number, with_error
from faintspot.base.statistics import Estimate, paired_mean
from faintspot.base.text_files import parse_json
from faintspot.experiments.closed_loop.results import (
    LOOP_GAIN,
    MagnitudeResult,
    differences_by_flux,
    gains_in_magnitude,
    magnitude_limit,
)
from faintspot.experiments.methods import Knowledge
from faintspot.loop.control.base import INTEGRATOR, split_control
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.estimators.base import Style
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.slopes.estimators.registry import estimators

_TEXT = Texts("faintspot.experiments")


def strehl_table(result: MagnitudeResult) -> page.Table:
    """Return the Strehl ratio of every method at each flux."""
    rows = [
        [label, *(with_error(paired_mean(runs)) for runs in of_method)]
        for label, of_method in zip(result.labels, result.strehl, strict=True)
    ]
    return _TEXT.table("tables.strehl", rows, _stars(result))


def settings_table(result: MagnitudeResult) -> page.Table:
    """Return the tuned loop gain and settings of every method at each flux."""
    rows = [
        [label, *map(_settings_words, choices, settings)]
        for label, choices, settings in zip(result.labels, result.choices, result.settings, strict=True)
    ]
    return _TEXT.table("tables.settings", rows, _stars(result))


def in_columns(table: page.Table) -> str:
    """Return a table of texts as lines for a terminal."""
    rows = [[str(cell) for cell in row] for row in (table.header, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.rjust, row[1:], widths[1:])) for row in rows)
    return "\n".join(f"{row[0]:{widths[0]}}  {line}" for row, line in zip(rows, lines, strict=True))


def _stars(result: MagnitudeResult) -> list[str]:
    stars = zip(result.photons, result.magnitudes, strict=True)
    return [f"{photons:.3g} e⁻, {magnitude:.1f} mag" for photons, magnitude in stars]


def _settings_words(choice: str, text: str) -> str:
    """Return tuned values as one line."""
    if not text:
        return "not tuned yet"
    options = [item for table in tomllib.loads(text).values() for item in table.items() if item[0] != "name"]
    words = (
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in options
    )
    return ", ".join([f"gain {parse_json(choice)[LOOP_GAIN]:.2g}", *words])


REFERENCES = Window.name, BrightestPixels.name
"""Baselines of every gain, first and second, both with the integrator."""


def loop_verdict(result: MagnitudeResult) -> list[str]:
    """Return what the results say about TV, and then about the other ways to measure slopes."""
    reference, *_ = reference_methods(result)
    methods = (method for method in range(len(result.labels)) if method != reference)
    compared = (_comparison(result, method, reference) for method in methods)
    lines = [*_recommendations(result), *compared]
    # What the denoising itself does: against the same without it.
    tv, without = tv_method(result), reference_methods(result)[-1]
    if tv is None or tv == without:
        return lines
    return [_headline(differences_by_flux(result, tv, without)), *lines]


def equal_methods(result: MagnitudeResult, flux: int) -> list[int]:
    """Return the methods that are not below the best at a flux beyond the error; the first is recommended.

    That is the baseline where it is among them, else the one that need not learn, has to know least and costs
    least. Differences are paired; their intervals hold for all comparisons with the best together.
    """
    runs = result.strehl[:, flux]
    measured = np.flatnonzero(np.isfinite(runs).all(axis=1))
    if not len(measured):
        return []
    best = measured[np.argmax(runs[measured].mean(axis=1))]
    comparisons = max(1, len(measured) - 1)
    same = [int(m) for m in measured if paired_mean(runs[best] - runs[m], comparisons).decided != 1]
    return sorted(same, key=lambda method: _simplicity(Method.named(result.names[method])))


def _simplicity(method: Method) -> tuple[object, ...]:
    beyond_baseline = method.name != REFERENCES[0], method.control != INTEGRATOR
    return *beyond_baseline, int(Knowledge.of(method.estimator)), method.estimator.cost, method.name


def _recommendations(result: MagnitudeResult) -> list[str]:
    """Return what is recommended at each flux, and limiting magnitudes at half of the best Strehl ratio."""
    lines, recommended = [], list[int]()
    for flux in reversed(range(len(result.photons))):
        if not (equal := equal_methods(result, flux)):
            continue
        label, *others = (result.labels[method] for method in equal)
        recommended.append(equal[0])
        values = ", ".join(
            f"{name} {value if isinstance(value, str) else plain_number(value)}"
            for name, value in parse_json(str(result.choices[equal[0], flux])).items()
        )
        star = {"magnitude": result.magnitudes[flux], "photons": plain_number(result.photons[flux])}
        as_good = ", ".join(others) or None
        lines.append(_sentence("recommended", label=label, values=values, others=as_good, **star))
    means = result.strehl.mean(axis=2)
    if np.isfinite(means).any() and len(result.photons) > 1:
        level = 0.5 * float(np.nanmax(means))
        limits = {
            result.labels[method]: magnitude_limit(result.magnitudes, result.strehl[method], level)
            for method in dict.fromkeys([*recommended, *reference_methods(result)])
        }
        known = [
            f"{label} {with_error(limit, 2, smallest=0.01)}"
            for label, limit in limits.items()
            if np.isfinite(limit.value)
        ]
        lines += [f"Limiting magnitudes at Strehl {level:.2f}: {', '.join(known)}."] if known else []
    return lines


def reference_methods(result: MagnitudeResult) -> list[int]:
    """Return the methods to compare others with: those of `REFERENCES` that are present, else the first."""
    return [result.names.index(name) for name in REFERENCES if name in result.names] or [0]


def tv_method(result: MagnitudeResult) -> int | None:
    """Return the method with TV, or None."""
    return result.names.index(TotalVariation.name) if TotalVariation.name in result.names else None


def _headline(comparisons: list[Estimate]) -> str:
    decided = [comparison.decided for comparison in comparisons if np.isfinite(comparison.low)]
    gains, losses = decided.count(1), decided.count(-1)
    return _sentence(
        "headline",
        measured=bool(decided),
        measured_fluxes=len(decided),
        gains=gains or None,
        nowhere=not gains,
        losses=losses or None,
    )


def _comparison(result: MagnitudeResult, method: int, reference: int) -> str:
    """Return a method's differences from the strongest baseline, and its gain in the middle of levels."""
    decided = [difference.decided for difference in differences_by_flux(result, method, reference)]

    def fluxes(outcome: int) -> str:
        if decided == [outcome] * len(decided):
            return "all fluxes"
        pairs = zip(result.photons, decided, strict=True)
        return ", ".join(f"{flux:.3g} e-" for flux, sign in pairs if sign == outcome)

    changes = [
        f"{word} Strehl beyond its error at {where}"
        for word, where in (("more", fluxes(1)), ("less", fluxes(-1)))
        if where
    ]
    levels = gains_in_magnitude(result, method, reference).items()
    gains = [(level, gain) for level, gain in levels if np.isfinite(gain.value) and not np.isnan(gain.low)]
    level, gain = gains[len(gains) // 2] if gains else (None, None)
    return _sentence(
        "compared",
        label=result.labels[method],
        reference=result.labels[reference],
        changes="; ".join(changes) or "no difference beyond its error at any flux",
        level=level,
        gain=gain,
    )


def _sentence(name: str, **values: object) -> str:
    return f"{_TEXT(f'verdict.lines.{name}', **values)}."


_WIDTH = 100


def loop_summary(result: MagnitudeResult) -> str:
    """Return the main table of a result and the verdict as text."""
    verdict = [textwrap.fill(line, _WIDTH, subsequent_indent="  ") for line in loop_verdict(result)]
    return "\n\n".join([in_columns(strehl_table(result)), "\n".join(verdict)])


_FEW_REALISATIONS = 5
_DODGE = 0.008  # of the axis, between methods at the same magnitude
_LEARNING_LINE = (0, (6, 1.5, 1, 1.5))


def loop_page(result: MagnitudeResult) -> page.Report:
    """Return the report page of closed-loop results."""
    configuration = LoopConfiguration.of_results(result.configuration)
    wavelength_um = 1.65 if configuration is None else configuration.science.wavelength_m * 1e6
    name = "" if configuration is None else f": “{configuration.name}”"
    references = reference_methods(result)
    figure = magnitude_figure(result, references[0], f"Strehl ratio at {wavelength_um:.3g} µm")
    base = " and then with ".join(result.labels[method] for method in references)
    sections = [
        _TEXT.section("verdict", *loop_verdict(result)),
        _TEXT.section("magnitude", strehl_table(result), figure, shape=result.strehl.shape, reference=base),
        _TEXT.section("settings", settings_table(result)),
        page.configuration_section(result.configuration),
    ]
    facts = {} if configuration is None else _facts(configuration)
    return page.Report(f"Closed loop{name}", facts, sections, loop_warnings(result), remark=page.POSITIONS)


def loop_warnings(result: MagnitudeResult) -> list[str]:
    """Return what a reader should know before the results: what is unfinished or too little."""
    missing, count = int(np.isnan(result.strehl).sum()), result.strehl.shape[-1]
    return _TEXT.lines(
        "loop.warnings",
        missing=missing or None,
        runs=result.strehl.size,
        few=count if count < _FEW_REALISATIONS else None,
        fewest=_FEW_REALISATIONS,
    )


def magnitude_figure(result: MagnitudeResult, reference: int, label: str) -> page.FigureWithData:
    """Draw Strehl against magnitude for every method, and its difference from the reference."""
    shift = _DODGE * float(np.ptp(result.magnitudes) or 1.0)
    strehls, differences = [], []
    for method, name in enumerate(result.labels):
        style = {**_style(result.names[method]), "capsize": 2}
        strehls.append(Line(name, result.magnitudes, *_means_of(result.strehl[method]), style))
        if method != reference:
            found = differences_by_flux(result, method, reference)
            low, middle, high = np.array([[d.low, d.value, d.high] for d in found]).T
            shifted = result.magnitudes + (method - len(result.labels) / 2) * shift
            differences.append(Line(name, shifted, middle, (middle - low, high - middle), style))
    above = result.magnitudes, result.photons.tolist(), "photo-electrons of a sub-aperture in a frame"
    than, magnitude = f"Strehl ratio minus that of {result.labels[reference]}, paired", "guide-star magnitude"
    left = Panel(strehls, magnitude, label, y_range=(0, None), above=above)
    right = Panel(differences, magnitude, than, levels={0.0: {}}, above=above)
    return _TEXT.figure("magnitude", [[left, right]], 6.4)


def _means_of(runs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of each row of runs, and its standard error, NaN where that is not known."""
    means = [paired_mean(values) for values in runs]
    return np.array([mean.value for mean in means]), np.array([mean.standard_error for mean in means])


def _style(name: str) -> dict[str, object]:
    """Return the style of a method's estimator; markers are hollow where the loop does more than the usual.

    Lines of control that learns are dash-dotted.
    """
    kinds = estimators()
    base = next((name[:end] for end in range(len(name), 0, -1) if name[:end] in kinds), "")
    style = kinds[base].style if base else Style("#666666")
    filling = style.colour if name == base else "white"
    line = _LEARNING_LINE if split_control(name)[1] else style.line
    return {"color": style.colour, "marker": style.marker, "ms": 6, "mfc": filling, "lw": 1.5, "ls": line}


def _facts(configuration: LoopConfiguration) -> dict[str, str]:
    """Return what was simulated, in words, for the top of the page."""
    camera, r0 = configuration.camera, configuration.atmosphere.r0_m
    return _TEXT.facts(
        "loop.facts",
        configuration,
        r0=f"{r0[0]:g} to {r0[1]:g}" if isinstance(r0, tuple) else f"{r0:g}",
        nm=configuration.sensor.wavelength_m * 1e9,
        layers=len(configuration.atmosphere.fraction),
        noise=camera.read_noise_e / camera.em_gain,
        gain=f", multiplication gain {camera.em_gain:g}" if camera.em_gain > 1 else "",
    )
