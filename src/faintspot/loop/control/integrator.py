"""Integrators, one of them compiled, and the product of a matrix with slopes while rows arrive."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import (
    SETTLE_FRAMES,
    CommandDelayLine,
    Controller,
    ExpectedSlopes,
    OpenLoopTelemetry,
    mean_residual,
    replayed_frames,
    replayed_integrators,
)
from faintspot.loop.control.reconstructor import Reconstructor
from faintspot.slopes.kernels.compiling import Direct, compiled_with
from faintspot.slopes.kernels.products import (
    ProductMemory,
    ProductPart,
    add_products,
    finish_product,
    is_measured,
)


class Integrator(Controller):
    """Integrator with leak: subtracts a fraction of each frame's wavefront from the command.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (2 n, commands) array
        Slopes in px that a unit of each command adds.
    reconstructor : Reconstructor
    gain : float
        Loop gain.
    leak : float
        Part of the command that is forgotten in every frame, so that a loop that has lost the star returns.
    weighted : bool
        Whether slopes count by their standard errors and covariances.
    sees_mirror : bool
        Whether the sensor is behind the mirror. If not (open loop), the command follows the running mean of
        the wavefront.
    """

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        reconstructor: Reconstructor,
        gain: float,
        leak: float,
        *,
        weighted: bool = False,
        sees_mirror: bool = True,
    ) -> None:
        super().__init__(line, interaction)
        self._reconstructor, self._leak = reconstructor, leak
        self.gain: float = gain
        self._weighted, self._sees_mirror = weighted, sees_mirror

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        if self._sees_mirror:
            return super().expected()
        return ExpectedSlopes(self._interaction @ -self.line.latest, None)

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`."""
        if self._weighted:
            wavefront = self._reconstructor.weighted(slopes_px, standard_error_px, covariance_xy_px2)
        else:
            wavefront = self._reconstructor(slopes_px)
        self.follow(wavefront)

    def follow(self, wavefront: Floats) -> None:
        """Update with this frame's wavefront, given as the commands that cause it."""
        forgotten = self._leak if self._sees_mirror else self.gain
        self.line.put((1 - forgotten) * self.line.latest - self.gain * wavefront)


_LEAST_BYTES = 500_000
"""Size of a matrix below which the product takes no longer than what it takes to begin it."""


class SlopeProduct:
    """Product of a matrix with the slopes of each frame, or with other vectors, in float32.

    A product that has been begun is that of the slopes as they were measured. When the whole product is asked
    for, only slopes that differ from these are left to do: those that have not been taken yet, and those that
    have changed since. Without a beginning these are all.

    Parameters
    ----------
    matrix : (c, 2 n) array
    """

    def __init__(self, matrix: NDArray[np.floating]) -> None:
        self.columns = np.ascontiguousarray(matrix.T, np.float32)
        """(2 n, c): the matrix, transposed."""
        m, c = self.columns.shape
        slopes, subtracted, result = (np.zeros(size, np.float32) for size in (m, m, c))
        self.memory = ProductMemory(slopes, subtracted, np.zeros((1, c), np.float32), result)
        self._expected = np.zeros(m)

    def __call__(self, vector: Floats) -> Floats:
        """Return the product, (c,)."""
        _FINISH(self.columns, vector, self.memory)
        return np.asarray(self.memory.result, np.float64)

    def several(self, *vectors: Floats) -> Floats:
        """Return the products with a few vectors, (vectors, c); the matrix is read once."""
        out = np.zeros((len(vectors), self.columns.shape[1]), np.float32)
        _ADD_PRODUCTS(self.columns, np.array(vectors, np.float32), out)
        return out.astype(np.float64)

    def parts(self, threads: int, scale: float, expected: Floats | None = None) -> Sequence[ProductPart]:
        """Return the parts of the next frame's product for each of the threads that measure its slopes.

        There are none of a small matrix, which is read faster than so many parts of it.

        Parameters
        ----------
        threads : int
        scale : float
            Factor on measured slopes.
        expected : (2 n,) array, optional
            Subtracted from scaled slopes. Default: 0.
        """
        if self.columns.nbytes < _LEAST_BYTES:
            return ()
        if len(self.memory.outs) != threads:
            outs = np.zeros((threads, self.columns.shape[1]), np.float32)
            self.memory = self.memory._replace(outs=outs)
        self._expected[:] = 0.0 if expected is None else expected
        slopes, subtracted, outs, _ = self.memory
        return [ProductPart(self.columns, scale, self._expected, slopes, subtracted, out) for out in outs]


_ADD_PRODUCTS, _FINISH = Direct(add_products), Direct(finish_product)


Singles = NDArray[np.float32]

_compiled = partial(compiled_with, source=__file__)

INVALID_PART, MEAN_SQUARE = range(2)
"""Summary of a frame from `true_slopes`: fraction of invalid sub-apertures; of the valid ones, the mean
square of a slope along one axis, px^2."""


@_compiled
def true_slopes(
    x: Singles,
    y: Singles,
    flags: NDArray[np.uint8],
    error_x: Singles,
    error_y: Singles,
    covariance_xy: Singles,
    gain: float,
    slopes: Floats,
    errors: Floats,
    covariance: Floats,
    statistics: Floats,
) -> None:
    """Write slopes [true px], all x, then all y, their errors and covariances; invalid: 0, infinite and 0.

    Parameters
    ----------
    x, y, flags, error_x, error_y, covariance_xy : (n,) arrays
        As in `faintspot.Slopes`.
    gain : float
        Centroid gain.
    slopes, errors : (2 n,) float64 arrays
    covariance : (n,) float64 array
        Covariances of x and y.
    statistics : (2,) float64 array
        `INVALID_PART`, `MEAN_SQUARE`.
    """
    n, scale = x.shape[0], 1.0 / gain
    invalid, square = 0, 0.0
    for s in range(n):
        along, across = x[s] * scale, y[s] * scale
        if is_measured(along, across, flags[s]):
            slopes[s], slopes[n + s] = along, across
            errors[s], errors[n + s] = error_x[s] * scale, error_y[s] * scale
            covariance[s] = covariance_xy[s] * scale * scale
            square += along * along + across * across
        else:
            slopes[s] = slopes[n + s] = 0.0
            errors[s] = errors[n + s] = np.inf
            covariance[s] = 0.0
            invalid += 1
    statistics[INVALID_PART] = invalid / n
    statistics[MEAN_SQUARE] = square / (2 * max(n - invalid, 1))


FLUX, DISPLACEMENT, FLUX_TIMES_DISPLACEMENT = range(3)
"""Summary of a frame from `displaced_flux`: means over the sub-apertures."""


@_compiled
def displaced_flux(
    commands: Floats, flux: Singles, columns: Singles, work: tuple[Singles, Singles], statistics: Floats
) -> None:
    """Write means of the flux, of the squared displacement by the mirror, and of their product.

    Parameters
    ----------
    commands : (commands,) float64 array
        Commands that acted in the frame.
    flux : (n,) float32 array
        What is not finite counts as 0.
    columns : (commands, 2 n) float32 array
        The interaction matrix, transposed, see `add_products`.
    work : tuple of (1, commands) and (1, 2 n) float32 arrays
        Commands, and displacements: all x, then all y.
    statistics : (3,) float64 array
        `FLUX`, `DISPLACEMENT` (px^2), `FLUX_TIMES_DISPLACEMENT`.
    """
    n = flux.shape[0]
    acting, displaced = work
    for c in range(commands.shape[0]):
        acting[0, c] = commands[c]
    displaced[:] = 0.0
    add_products(columns, acting, displaced)
    statistics[:] = 0.0
    for s in range(n):
        square = displaced[0, s] * displaced[0, s] + displaced[0, n + s] * displaced[0, n + s]
        flux_e = flux[s] if np.isfinite(flux[s]) else 0.0
        statistics[FLUX] += flux_e / n
        statistics[DISPLACEMENT] += square / n
        statistics[FLUX_TIMES_DISPLACEMENT] += flux_e * square / n


@_compiled
def integrate_wavefront(
    wavefront: Any, latest: Any, gain: Any, keep: Any, largest: Any, command: Any
) -> float:
    """Write the next command: `keep` times the latest minus `gain` times the wavefront, clipped.

    Return the command's sum before it was clipped.

    Parameters
    ----------
    wavefront : (commands,) float32 or float64 array
        As the commands that cause it.
    latest, command, largest : (commands,) float64 array
    gain, keep : float
    """
    total = 0.0
    for c in range(command.shape[0]):
        value = keep * latest[c] - gain * wavefront[c]
        total += value
        command[c] = min(max(value, -largest[c]), largest[c])
    return total


@_compiled
def integrate(
    slopes: Any, columns: Any, gain: Any, keep: Any, largest: Any, rows: Any, next_row: Any, memory: Any
) -> float:
    """Write the next command from slopes; see `integrate_wavefront`.

    Parameters
    ----------
    slopes : (m,) float64 array
        Finite.
    columns : (m, commands) float32 array, contiguous
        The reconstructor, transposed, see `add_products`. Reading it takes most of the time of large sensors.
    gain, keep : float
    largest : (commands,) float64 array
    rows : (delay + 1, commands) float64 array
        Of a `CommandDelayLine`.
    next_row : int
        Which row to write; the latest command is in the one before.
    memory : ProductMemory
        Of the wavefront.
    """
    latest = rows[(next_row or rows.shape[0]) - 1]
    finish_product(columns, slopes, memory)
    total: float = integrate_wavefront(memory.result, latest, gain, keep, largest, rows[next_row])
    return total


_INTEGRATE = Direct(integrate)


class CompiledIntegrator(Controller):
    """Compiled `control.integrator.Integrator` with equal weights of all slopes.

    Parameters
    ----------
    line : CommandDelayLine
    interaction : (m, commands) array
        Slopes in px that a unit of each command adds.
    reconstruct : (commands, m) array
        The wavefront from slopes, as commands that cause it.
    gain : float
        May be changed between two frames.
    leak : float
        Part of the command that is forgotten in every frame.
    """

    gain: float

    def __init__(
        self, line: CommandDelayLine, interaction: Floats, reconstruct: Floats, gain: float, leak: float
    ) -> None:
        super().__init__(line, interaction)
        self._wavefront = SlopeProduct(reconstruct)
        self.gain, self._keep = float(gain), 1.0 - leak

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`; invalid slopes are 0, and all count the same."""
        line, product = self.line, self._wavefront
        numbers = self.gain, self._keep, line.largest
        total = _INTEGRATE(slopes_px, product.columns, *numbers, line.rows, line.next_row, product.memory)
        line.sent(total)

    def begin_product(self, threads: int, scale: float) -> Sequence[ProductPart]:
        """See `Controller`."""
        return self._wavefront.parts(threads, scale)


Make = Callable[[CommandDelayLine], Controller]


def settled(telemetry: OpenLoopTelemetry) -> int:
    """Return the number of frames at the start of a replay that are not scored."""
    return min(SETTLE_FRAMES, len(telemetry) // 3)


@dataclass(frozen=True, eq=False)
class LoopPlant:
    """Properties of the loop that a controller needs: matrices, delay, leak."""

    interaction: Floats
    """(m, commands): slopes [px] per unit of each command."""
    reconstructor: Reconstructor
    delay_frames: int
    leak: float

    def integrator(self, gain: float, line: CommandDelayLine) -> Integrator:
        """Return an integrator of this loop."""
        return Integrator(line, self.interaction, self.reconstructor, gain, self.leak)

    def replayed(self, make: Make, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that a controller would have left; see `replayed_frames`."""
        return replayed_frames(make, telemetry, self.interaction, phase, self.delay_frames)

    def replayed_integrators(
        self, gains: Sequence[float], telemetry: OpenLoopTelemetry, phase: Floats
    ) -> Floats:
        """Return the squared residuals of integrators, (gains, frames)."""
        of_loop = self.interaction, self.reconstructor, phase, self.delay_frames, self.leak
        return replayed_integrators(gains, telemetry, *of_loop)

    def best_gain(
        self, gains: Sequence[float], telemetry: OpenLoopTelemetry, phase: Floats
    ) -> tuple[float, float]:
        """Return the gain of the integrator that leaves the least phase variance, and that variance."""
        residuals = self.replayed_integrators(gains, telemetry, phase)
        variances = [mean_residual(residual, telemetry, settled(telemetry)) for residual in residuals]
        best = int(np.argmin(variances))
        return gains[best], variances[best]

    def residual(self, make: Make, telemetry: OpenLoopTelemetry, phase: Floats) -> float:
        """Return the phase variance that a controller would have left; see `mean_residual`."""
        return mean_residual(self.replayed(make, telemetry, phase), telemetry, settled(telemetry))
