"""Files of a mirror calibration: matrices for [control], and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.files import derived, write_atomically
from faintspot.base.npz import save_arrays
from faintspot.loop.control.configuration import INTERACTION, REFERENCE, save_control
from faintspot.loop.control.mirror_calibration import MirrorCalibration
from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]


def save_calibration(path: str | Path, calibration: MirrorCalibration, reference: Floats) -> Path:
    """Write a calibration beside a configuration file, as NAME.control.npz, and name it in [control].

    Parameters
    ----------
    path : path
        faintspot.toml.
    calibration : MirrorCalibration
    reference : (2 n,) array
        Reference slopes, px: those found, on top of what was subtracted already.

    Returns
    -------
    Path
        Of the arrays: interaction_matrix, reference_slopes, and their standard errors.

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    store = derived(path, ".control.npz")
    arrays = {
        INTERACTION: calibration.interaction,
        "interaction_error": calibration.interaction_error,
        REFERENCE: reference,
        "reference_error": calibration.reference_error,
    }
    save_arrays(store, arrays)
    names = {name: f"{store.name}:{name}" for name in (INTERACTION, REFERENCE)}
    save_control(path, **names, centroid_gain=1.0)
    return store


def save_picture(path: str | Path, calibration: MirrorCalibration, reference: Floats, layout: Layout) -> None:
    """Draw a calibration as a PNG picture: matrix, response of each actuator, reference slopes.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    InputError
        When the file cannot be written.
    """
    from faintspot.base.report.drawing import GREY, METHOD_COLOURS, WIDTH, new_figure, png, styled

    @styled
    def drawn() -> bytes:
        figure = new_figure(WIDTH, 4.4)
        matrix, answers, spots = figure.subplots(1, 3, width_ratios=[1.2, 1, 1])
        moved = calibration.interaction * calibration.amplitude
        largest = float(np.abs(moved).max())
        shown = matrix.imshow(
            moved, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest, origin="upper"
        )
        figure.colorbar(shown, ax=matrix, label=f"px for {calibration.amplitude:g}")
        matrix.set(title="Interaction matrix", xlabel="command", ylabel="slope: all x, then all y")
        size, error = (
            np.sqrt(np.square(slopes).mean(axis=0)) * calibration.amplitude
            for slopes in (calibration.interaction, calibration.interaction_error)
        )
        actuators = np.arange(len(size))
        answers.plot(actuators, size, "o", ms=4, color=METHOD_COLOURS[1], label="slopes")
        answers.plot(actuators, error, "_", ms=6, color=METHOD_COLOURS[0], label="their standard error")
        for actuator in actuators[~calibration.answers]:
            answers.axvline(actuator, color=GREY, lw=1, ls=":")
        answers.set(title="How far each actuator answers", xlabel="command", ylabel="rms slope of a poke, px")
        answers.set_ylim(bottom=0)
        answers.legend(loc="best")
        x, y = layout.corners[:, ::-1].T + (np.array(layout.window[::-1])[:, None] - 1) / 2 + layout.offsets.T
        spots.plot(x, y, "+", ms=4, color=GREY)
        spots.quiver(x, y, *reference.reshape(2, -1), angles="xy", color=METHOD_COLOURS[1])
        rms = float(np.sqrt(np.square(reference).mean()))
        spots.set(title=f"Reference slopes, {rms:.2g} px rms", xlabel="column, px", ylabel="row, px")
        spots.set_aspect("equal")
        spots.margins(0.1)
        return png(figure)

    write_atomically(path, drawn())
