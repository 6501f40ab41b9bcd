"""Command that would flatten a measured wavefront."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError
from faintspot.base.files import check_ending, csv_text, write_atomically
from faintspot.loop.control.reconstructor import Reconstructor, make_reconstructor
from faintspot.slopes.pipeline.slopes import Slopes


@dataclass(frozen=True, eq=False)
class Flattening:
    """Command that would flatten the mean wavefront, on top of the present command."""

    command: Floats
    """(actuators,), in the unit of the interaction matrix."""
    interaction: Floats
    """(2 n, actuators)"""
    combinations: int
    """Number of combinations of actuators that are driven."""
    before_px: float
    """Rms of the mean slopes per axis, over the sub-apertures that are valid in at least one frame."""
    after_px: float
    """Rms of the same slopes with the command."""
    noise_px: float
    """Rms of the standard errors of the mean slopes; not finite if unknown."""
    stroke: float | None

    @property
    def slopes_px(self) -> Floats:
        """Slopes that the command adds, all x, then all y, (2 n,)."""
        return self.interaction @ self.command

    @property
    def clipped(self) -> int:
        """Number of actuators at the stroke limit."""
        at_limit = np.abs(self.command) >= (np.inf if self.stroke is None else 0.999 * self.stroke)
        return int(np.count_nonzero(at_limit))

    def remarks(self) -> list[str]:
        """Return sentences for the reader: what the command removes, what it leaves and why."""
        actuators = len(self.command)
        removed = 1 - (self.after_px / self.before_px) ** 2 if self.before_px > 0 else 0.0
        lines = [
            f"The command removes {100 * removed:.3g} % of the mean square of the mean slopes: "
            f"{self.before_px:.3g} px rms per axis become {self.after_px:.3g} px, predicted by the "
            "interaction matrix."
        ]
        if np.isfinite(self.noise_px):
            lines.append(f"Noise alone leaves about {self.noise_px:.2g} px in the mean slopes.")
        weak = "" if self.combinations == actuators else "; the slopes show the others too weakly"
        lines.append(
            f"{self.combinations} combinations of {actuators} actuators are driven{weak}. The largest "
            f"command is {np.abs(self.command).max():.4g}, in the unit of the interaction matrix."
        )
        if self.stroke is not None:
            lines.append(
                f"{self.clipped} of {actuators} actuators are at the stroke limit of {self.stroke:g}; the "
                "others take over part of their share."
            )
        return lines


def flattening(slopes: Slopes, interaction: ArrayLike, stroke: float | None = None) -> Flattening:
    """Return the command that would flatten the mean wavefront of slopes, by least squares.

    Combinations of actuators are driven as by `Reconstructor.clean`, which damps weak ones a little so that
    they do not follow noise. Only valid slopes count. With a stroke limit the command is the best one within
    it.

    Parameters
    ----------
    slopes : Slopes
        Slopes of one frame or several, relative to the reference to flatten to.
    interaction : (2 n, actuators) array
        Slopes for a unit of each actuator [px], all x, then all y.
    stroke : float, optional
        Largest size of a command.

    Raises
    ------
    InputError
        When slopes and matrix do not fit together, no slope is valid, or `make_reconstructor` refuses the
        matrix.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.loop.control.flattening import flattening
    >>> layout = fs.Layout.grid((4, 4), pixels=8)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 5, flux_e=1000.0,
    ...     positions=np.tile([0.5, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> tip_tilt = np.kron(np.eye(2), np.full((len(layout), 1), 0.1))  # 0.1 px for a unit
    >>> tip, tilt = flattening(slopes, tip_tilt).command
    >>> print(f"{tip:.1f}")
    -4.9
    """
    x, y = (np.atleast_2d(values).astype(np.float64) for values in (slopes.x, slopes.y))
    n = x.shape[1]
    matrix: Floats = finite_array("interaction", interaction).astype(np.float64)
    if matrix.ndim != 2 or len(matrix) != 2 * n:
        hint = "; transpose it" if matrix.ndim == 2 and matrix.shape[1] == 2 * n else ""
        raise InputError(
            f"interaction: expected shape ({2 * n}, actuators), x of all {n} sub-apertures, then y, got "
            f"{matrix.shape}{hint}"
        )
    if stroke is not None:
        stroke = number_between("stroke", stroke, 0, low_open=True)
    valid = np.tile(np.atleast_2d(slopes.valid), 2)
    used = valid.any(axis=0)
    if not used.any():
        raise InputError("slopes: expected valid slopes to flatten, found none")
    reconstructor = make_reconstructor(matrix[used])
    count = np.maximum(valid.sum(axis=0), 1)
    mean = np.where(valid, np.concatenate([x, y], axis=1), 0.0).sum(axis=0) / count
    errors = [np.atleast_2d(getattr(slopes, f"standard_error_{axis}")) for axis in "xy"]
    squares = np.where(valid, np.square(np.concatenate(errors, axis=1), dtype=np.float64), 0.0)
    variance = squares.sum(axis=0) / count**2
    command = _command(reconstructor, -mean[used], stroke)
    before, after = (float(np.sqrt(np.mean(values[used] ** 2))) for values in (mean, mean + matrix @ command))
    noise = float(np.sqrt(np.mean(variance[used])))
    return Flattening(command, matrix, reconstructor.modes.shape[1], before, after, noise, stroke)


def _command(reconstructor: Reconstructor, slopes: Floats, stroke: float | None) -> Floats:
    """Return the command that moves the slopes by `slopes`, by damped least squares within the stroke."""
    command: Floats = reconstructor.clean @ slopes
    if stroke is None or np.abs(command).max() <= stroke:
        return command
    actuators = len(command)
    driven = reconstructor.slopes_of_modes @ reconstructor.modes.T
    damping = np.sqrt(reconstructor.damping) * np.eye(actuators)
    bounded = scipy.optimize.lsq_linear(
        np.concatenate([driven, damping]), np.concatenate([slopes, np.zeros(actuators)]), (-stroke, stroke)
    )
    return np.asarray(np.clip(bounded.x, -stroke, stroke))


def check_command_file(path: Path) -> None:
    """Refuse an unknown ending before the work."""
    check_ending(path, ".npy", ".csv")


def save_command(path: str | Path, command: Floats) -> None:
    """Write a command, replacing an existing file: .npy, or .csv with actuators from 0.

    Raises
    ------
    InputError
        When the ending is unknown, or the file cannot be written.
    """
    path = Path(path)
    check_command_file(path)
    if path.suffix.lower() == ".npy":
        write_atomically(path, lambda stream: np.save(stream, command))
    else:
        rows = [(number, f"{value:.9g}") for number, value in enumerate(command)]
        write_atomically(path, csv_text(("actuator", "command"), rows))


_CORNERS = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
_UNSEEN = 0.05  # of the largest singular value: piston and waffle, which slopes do not show
_MASS = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6  # products of linear elements, integrated over a side


def residual_phase(matrix: Floats, interaction: Floats, cells: ArrayLike) -> Floats:
    """Return the matrix (commands, 2 n) from slopes to amplitudes whose sum of squares is the phase variance.

    Parameters
    ----------
    matrix : (commands, 2 n) array
        From slopes to commands, as of a `Reconstructor`.
    interaction, cells
        As for `phase_of_commands`.
    """
    return np.asarray(phase_of_commands(interaction, cells) @ matrix)


def phase_of_commands(interaction: Floats, cells: ArrayLike) -> Floats:
    """Return the matrix (commands, commands) to amplitudes whose sum of squares is the phase variance.

    Commands cause a wavefront that is bilinear between the corners of the sub-apertures (Fried 1977,
    JOSA 67, 370); its variance over all sub-apertures is in (px x side of a sub-aperture)^2.

    Parameters
    ----------
    interaction : (2 n, commands) array
        Slopes for a unit of each command.
    cells : (n, 2) array of int
        Row and column of each sub-aperture in the lenslet array.
    """
    slopes, mass, mean = _corner_geometry(np.asarray(cells))
    corners = np.linalg.pinv(slopes, rcond=_UNSEEN) @ interaction
    corners -= mean @ corners
    values, vectors = np.linalg.eigh(corners.T @ mass @ corners)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _corner_geometry(cells: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Return slopes (2 n, corners) of the phase at corners, and matrix and weights of its square and mean."""
    n = len(cells)
    cell_corners = cells[:, None] + _CORNERS
    corners, of_cell = np.unique(cell_corners.reshape(-1, 2), axis=0, return_inverse=True)
    of_cell = of_cell.reshape(n, len(_CORNERS))
    slopes, mass = np.zeros((2 * n, len(corners))), np.zeros((len(corners),) * 2)
    for number, corner in enumerate(of_cell):
        slopes[number, corner] = _CORNERS[:, 1] - 0.5
        slopes[n + number, corner] = _CORNERS[:, 0] - 0.5
        mass[np.ix_(corner, corner)] += np.kron(_MASS, _MASS) / n
    return slopes, mass, mass.sum(axis=0)
