"""The tables of the closed-loop report."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence

from faintspot.experiments.loop_analysis import (
    NO_TV,
    Measurements,
    differences_by_flux,
    gains_in_magnitude,
    regression_lines,
    seeing_of_sets,
    strehl_table,
)
from faintspot.experiments.loop_arms import LOOP_GAIN
from faintspot.experiments.loop_results import (
    InterleavedResult,
    MagnitudeResult,
    gain_in_words,
    in_words,
    with_error,
)
from faintspot.experiments.statistics import paired_mean
from faintspot.report.page import Table


def strehl_groups_table(result: InterleavedResult, table: Measurements) -> Table:
    """Return the paper's table, of all sets together and of each, with paired differences."""
    rows = [_group_rows("all sets", table, None)]
    rows += [_group_rows(name, table, number) for number, name in enumerate(result.set_names)]
    return Table(
        [
            "set",
            "group",
            "mean Strehl",
            "standard deviation",
            "measurements",
            "paired difference",
            "at equal r0",
        ],
        [row for part in rows for row in part],
        "Standard deviation: of the measurements, mostly the drift of r0. Paired difference: from the "
        "neighbouring measurements without TV, with its 95 % interval from drawing whole cycles. At equal "
        "r0: the same after the dependence of Strehl on the measured r0 is taken out, of measurements "
        "that tell "
        "it, which those are not where the loop lost the star. “All strengths”: above 0.",
    )


def regression_table(table: Measurements) -> Table:
    """Return the regression lines of Strehl against r0."""
    return Table(
        ["group", "slope (Strehl for 1 cm of r0)", "correlation", "measurements"],
        [
            [
                name,
                f"{line.slope / 100:.4f} ({line.slope_low / 100:.4f} to {line.slope_high / 100:.4f})",
                f"{line.correlation:.2f}",
                str(line.count),
            ]
            for name, line in regression_lines(table).items()
        ],
        "Strehl against r0: least-squares lines, slopes with 95 % intervals.",
    )


def _group_rows(name: str, table: Measurements, number: int | None) -> list[list[str]]:
    return [
        [
            name,
            row.group,
            f"{row.mean:.3f}",
            f"{row.standard_deviation:.3f}" if row.count > 1 else "–",
            str(row.count),
            *(("", "") if row.group == NO_TV else (in_words(row.difference), in_words(row.at_equal_r0))),
        ]
        for row in strehl_table(table, number)
    ]


def seeing_table(result: InterleavedResult) -> Table:
    """Return r0 of each set, measured in several ways, and the truth."""
    rows = [
        [
            item.set_name,
            f"{100 * item.true_r0_m:.1f}",
            *(
                f"{100 * value:.1f} ({100 * (value / item.true_r0_m - 1):+.0f} %)".replace("-", "−")
                for value in (
                    item.seeing.r0_m,
                    item.seeing.r0_x_m,
                    item.seeing.r0_y_m,
                    item.with_tip_tilt.r0_m,
                    item.with_tip_tilt.r0_kolmogorov_m,
                )
            ),
            f"{item.seeing.noise_std_px:.2f}",
        ]
        for item in seeing_of_sets(result)
    ]
    return Table(
        [
            "set",
            "true",
            "measured",
            "x alone",
            "y alone",
            "with tip and tilt",
            "Kolmogorov",
            "slope noise (px)",
        ],
        rows,
        "r0 in cm at 500 nm from all frames of a set, and its deviation from the truth. Measured: from "
        "slopes "
        "about their mean over the pupil. Kolmogorov: what whole slopes give when the outer scale is "
        "ignored.",
    )


def gain_table(result: MagnitudeResult, arms: Sequence[int], reference: int) -> Table:
    """Return the gains in limiting magnitude of arms over a reference at equal Strehl."""
    gains = {arm: gains_in_magnitude(result, arm, reference) for arm in arms}
    levels = next(([gain.strehl for gain in found] for found in gains.values()), [])
    return Table(
        ["arm", *(f"at Strehl {level:g}" for level in levels)],
        [[result.labels[arm], *(gain_in_words(gain) for gain in found)] for arm, found in gains.items()],
        f"Gain in limiting magnitude over {result.labels[reference]} at equal Strehl ratio, with its 95 % "
        "interval "
        "from drawing realisations. Read between the magnitudes measured, never beyond; “beyond” in an "
        "interval: "
        "more than 2.5 % of the draws left them. Strehl ratios that the reference does not pass are not "
        "listed.",
    )


def difference_table(result: MagnitudeResult, pairs: Sequence[tuple[int, int]], caption: str = "") -> Table:
    """Return the difference in Strehl of pairs of arms at each flux."""
    return Table(
        ["arm", "less", *(f"{photons:.3g}" for photons in result.photons)],
        [
            [
                result.labels[arm],
                result.labels[other],
                *(in_words(each) for each in differences_by_flux(result, arm, other)),
            ]
            for arm, other in pairs
        ],
        f"{caption} Difference in Strehl at each number of photo-electrons, with intervals that hold for all "
        "fluxes of a row together with 95 %.".strip(),
    )


def centroid_gain_table(result: MagnitudeResult) -> Table:
    """Return the centroid gain of every arm at each flux."""
    return Table(
        ["arm", *(f"{photons:.3g}" for photons in result.photons)],
        [
            [label, *(with_error(paired_mean(values), 2) for values in result.centroid_gain[arm])]
            for arm, label in enumerate(result.labels)
        ],
        "At each number of photo-electrons, with its standard error. Slopes are divided by it, except in "
        "arms that start from the loop’s own prediction.",
    )


def settings_table(result: MagnitudeResult) -> Table:
    """Return the tuned loop gain and settings of every arm at each flux."""
    rows = [
        [
            label,
            *(_settings_words(*each) for each in zip(result.choices[arm], result.settings[arm], strict=True)),
        ]
        for arm, label in enumerate(result.labels)
    ]
    return Table(
        ["arm", *(f"{photons:.3g}" for photons in result.photons)],
        rows,
        "At each number of photo-electrons: loop gain, and settings that are not the default ones.",
    )


def _settings_words(choice: str, text: str) -> str:
    """Return tuned values as one line."""
    if not text:
        return "not tuned yet"
    parts = [f"gain {json.loads(choice)[LOOP_GAIN]:.2g}"]
    for options in tomllib.loads(text).values():
        parts += [_value_words(name, value) for name, value in options.items() if name != "name"]
    return ", ".join(parts)


def _value_words(name: str, value: object) -> str:
    return f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
