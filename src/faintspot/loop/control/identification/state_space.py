"""Predictive filter at constant noise as plain matrices, for controllers in other languages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.extras import require
from faintspot.base.files import write_atomically
from faintspot.base.npz import save_arrays
from faintspot.loop.control.identification.model import ControlModel, LoopPlant
from faintspot.loop.control.kalman.predictor import SlopePredictor

Floats = NDArray[np.float64]

_ENDINGS = (".npz", ".mat", ".fits")


def state_space(
    model: ControlModel, plant: LoopPlant, scale: Floats | float, sign: float
) -> dict[str, Floats]:
    """Return the matrices of a frame's command and of the next state, without the guard.

    With the slopes s of a frame, the commands u that the mirror holds during it, and the state x, 0 first::

        command = command_of_state x + command_of_slopes s + command_of_mirror u
        x = state_of_state x + state_of_slopes s + state_of_mirror u

    Parameters
    ----------
    model : ControlModel
        Kalman filter of a small sensor.
    plant : LoopPlant
    scale : float or (2 n,) array
        The model's slopes in a unit of s.
    sign : float
        -1 where commands are subtracted from the turbulence.

    Raises
    ------
    InputError
        When the filter is one for large sensors.
    """
    predictor = model.predictor()
    if not isinstance(predictor, SlopePredictor):
        slopes = len(plant.interaction)
        raise InputError(
            f"export: expected a filter of up to 300 slopes, whose matrices are small, got {slopes}"
        )
    gain = np.linalg.solve(predictor.usual_px2, predictor.with_slopes.T).T
    rest = np.eye(predictor.model.states) - gain @ predictor.model.observation
    command = -sign * plant.reconstructor.clean @ predictor.model.ahead(plant.delay_frames)
    matrices = {}
    for name, onward in (("command", command), ("state", predictor.model.onward)):
        matrices[f"{name}_of_state"] = onward @ rest
        matrices[f"{name}_of_slopes"] = onward @ gain * scale
        matrices[f"{name}_of_mirror"] = -sign * onward @ gain @ plant.interaction
    return matrices


def write_matrices(path: str | Path, arrays: dict[str, Any]) -> None:
    """Write arrays to a file whose ending says the format: .npz, .mat (MATLAB 5) or .fits (one image each).

    Raises
    ------
    InputError
        When the ending is another one, or the file cannot be written.
    MissingExtraError
        When astropy is not installed, for FITS.
    """
    path = Path(path)
    if path.suffix == ".npz":
        save_arrays(path, arrays)
    elif path.suffix == ".mat":
        from scipy.io import savemat

        write_atomically(path, lambda stream: savemat(stream, arrays))
    elif path.suffix == ".fits":
        require("io", "astropy", purpose="export to FITS")
        from astropy.io import fits

        images = [fits.ImageHDU(np.atleast_1d(array), name=name.upper()) for name, array in arrays.items()]
        file = fits.HDUList([fits.PrimaryHDU(), *images])
        write_atomically(path, lambda stream: file.writeto(stream))
    else:
        raise InputError(f"{path}: expected a name that ends in {', '.join(_ENDINGS)}")
