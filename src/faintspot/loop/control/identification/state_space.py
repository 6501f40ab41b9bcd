"""Predictive filter at constant noise as plain matrices, for controllers in other languages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from faintspot.base.errors import InputError
from faintspot.base.files import write_atomically
from faintspot.base.npz import save_arrays
from faintspot.io.arrays.fits_units import write_images
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.kalman.local_model import slopes_ahead, state_of_state, state_of_surprise
from faintspot.loop.control.plant import LoopPlant

Floats = NDArray[np.float64]
Matrices = dict[str, Any]

_ENDINGS = (".npz", ".mat", ".fits")


def state_space(model: Kalman, plant: LoopPlant, scale: Floats | float, sign: float) -> Matrices:
    """Return the matrices of a frame's command and of the next state, without the guard.

    With the slopes s of a frame, the commands u that the mirror holds during it, and the state x, 0 first::

        command = command_of_state x + command_of_slopes s + command_of_mirror u
        x = state_of_state x + state_of_slopes s + state_of_mirror u

    Of a large sensor, with the latest command v, all `_of_state` and `_of_surprise` of the state sparse::

        surprise = s - slopes_of_state x - slopes_of_mirror u
        command = v - command_of_ahead (ahead_of_state x + slopes_of_mirror v) + command_of_surprise surprise
        x = state_of_state (x + state_of_surprise surprise)

    Parameters
    ----------
    model : Kalman
    plant : LoopPlant
    scale : float or (2 n,) array
        The model's slopes in a unit of s.
    sign : float
        -1 where commands are subtracted from the turbulence.
    """
    if model.is_local:
        return _sparse(model.arrays, plant, scale, sign)
    predictor = model.slope_predictor
    gain = np.linalg.solve(predictor.usual_px2, predictor.with_slopes.T).T
    rest = np.eye(predictor.model.states) - gain @ predictor.model.observation
    command = -sign * plant.reconstructor.clean @ predictor.model.ahead(plant.delay_frames)
    matrices = {}
    for name, onward in (("command", command), ("state", predictor.model.onward)):
        matrices[f"{name}_of_state"] = onward @ rest
        matrices[f"{name}_of_slopes"] = onward @ gain * scale
        matrices[f"{name}_of_mirror"] = -sign * onward @ gain @ plant.interaction
    return matrices


def _sparse(arrays: Mapping[str, Floats], plant: LoopPlant, scale: Floats | float, sign: float) -> Matrices:
    """Return the matrices of a large sensor in float32, as its filter has them."""
    scale = np.broadcast_to(scale, len(plant.interaction))
    to_unit = sparse.diags(1 / scale).tocsr()
    ahead = slopes_ahead(arrays, plant.delay_frames)
    corrections = state_of_surprise(arrays) @ sparse.diags(scale).tocsr()
    clean = sign * plant.reconstructor.clean
    matrices = {
        "state_of_state": state_of_state(arrays),
        "state_of_surprise": corrections,
        "slopes_of_state": to_unit @ slopes_ahead(arrays, 0),
        "ahead_of_state": to_unit @ ahead,
        "slopes_of_mirror": sign * plant.interaction / scale[:, None],
        "command_of_ahead": scale * clean,
        "command_of_surprise": -((ahead @ corrections).T @ clean.T).T,
    }
    return {name: matrix.astype(np.float32) for name, matrix in matrices.items()}


def write_matrices(path: str | Path, arrays: Matrices) -> None:
    """Write arrays to a file whose ending says the format: .npz, .mat (MATLAB 5) or .fits (one image each).

    A sparse matrix NAME is one of MATLAB's, or has its compressed rows as NAME_data, NAME_indices,
    NAME_indptr and NAME_shape, for `scipy.sparse.csr_matrix`.

    Raises
    ------
    InputError
        When the ending is another one, or the file cannot be written.
    MissingExtraError
        When astropy is not installed, for FITS.
    """
    path = Path(path)
    if path.suffix == ".npz":
        save_arrays(path, _plain(arrays))
    elif path.suffix == ".mat":
        from scipy.io import savemat

        doubles = {name: array.astype(np.float64) for name, array in arrays.items()}  # all that MATLAB's have
        write_atomically(path, lambda stream: savemat(stream, doubles))
    elif path.suffix == ".fits":
        write_images(path, {name.upper(): array for name, array in _plain(arrays).items()})
    else:
        raise InputError(f"{path}: expected a name that ends in {', '.join(_ENDINGS)}")


def _plain(arrays: Matrices) -> Matrices:
    """Return the arrays with sparse ones in parts."""
    plain: Matrices = {}
    for name, array in arrays.items():
        if sparse.issparse(array):
            parts = {"data": array.data, "indices": array.indices, "indptr": array.indptr}
            parts["shape"] = np.array(array.shape)
            plain |= {f"{name}_{part}": values for part, values in parts.items()}
        else:
            plain[name] = array
    return plain
