"""Guarded predictive control of large sensors: each matrix is read once in a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.control.base import Expected
from faintspot.control.commands import CommandDelayLine
from faintspot.control.compiled import add_products
from faintspot.control.guarded import Guarded
from faintspot.control.integrator import Integrator
from faintspot.control.local_kalman import LocalPredictor
from faintspot.control.predictive import Predictive
from faintspot.control.reconstructor import Reconstructor
from faintspot.control.telemetry import without_prior
from faintspot.kernels.compiling import Direct

Floats = NDArray[np.float64]

_LEARNT, _PLAIN = range(2)


class LargeGuarded(Guarded):
    """`Guarded` with `Predictive` and the integrator, for large sensors.

    Reading matrices takes most of the time of a frame. They are kept in float32, and each is read once.
    Before the command goes out, one product is computed; three more follow with the next frame, or when
    somebody asks what is expected.

    Parameters
    ----------
    line : CommandDelayLine
        To the mirror.
    interaction : (m, commands) array
    reconstructor : Reconstructor
    phase : (k, m) array
        From slopes to the compared amplitudes, see `residual_phase`.
    predictor : LocalPredictor
    plain_gain, leak : float
        Of the integrator.
    options
        As for `Guarded`.
    """

    def __init__(
        self,
        line: CommandDelayLine,
        interaction: Floats,
        reconstructor: Reconstructor,
        phase: Floats,
        predictor: LocalPredictor,
        plain_gain: float,
        leak: float,
        **options: Any,
    ) -> None:

        def learnt(line: CommandDelayLine) -> Predictive:
            return Predictive(line, interaction, predictor, reconstructor.clean, from_latest=True)

        def plain(line: CommandDelayLine) -> Integrator:
            return Integrator(line, interaction, reconstructor, plain_gain, leak)

        super().__init__(line, interaction, phase, learnt, plain, **options)
        self._predictor, self._gain, self._keep = predictor, plain_gain, 1.0 - leak
        self._product = _Product(interaction)
        self._reconstruct, self._clean = _Product(reconstructor.matrix), _Product(reconstructor.clean)
        self._compare = _Product(phase)
        self._held = np.zeros((5, len(interaction)))
        """Slopes that commands cause: of mirror, filter and integrator, acting; of the latter two, latest."""
        self._held_at = -1
        self._rest: tuple[Floats, ...] | None = None
        """Slopes of the previous frame, as far as it is not complete."""

    def expected(self) -> Expected:
        """See `Controller`."""
        self._complete()
        held, _, _, _, latest = self._held
        if self.chosen == _PLAIN:
            return Expected(held - latest, None)
        return Expected(held + self._predictor.mean_px, self._predictor.std_px)

    def fall_back(self) -> None:
        """See `Guarded`."""
        self._complete()
        super().fall_back()

    def begin(self) -> None:
        """See `Controller`; both restart from there."""
        super().begin()
        self._rest, self._held_at = None, -1

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`; noise of x and y is taken to be independent."""
        expected = self.expected().mean_px
        alone, variance, trust = without_prior(slopes_px, standard_error_px, expected, self.prior_std_px)
        held, of_learnt, of_plain, _, latest = self._held
        open_loop = alone - held
        left = trust * (open_loop + of_learnt), trust * (open_loop + of_plain)
        expects = of_plain - latest
        for_plain = expects + trust * (open_loop + of_plain - expects)
        self._follow(self.chosen, open_loop, self._noise_factor * variance, for_plain)
        self._send()
        self._rest = open_loop, self._noise_factor * variance, for_plain, *left

    def _follow(self, which: int, open_loop: Floats, variance: Floats, for_plain: Floats) -> None:
        """Update one of the controllers."""
        line = self._lines[which]
        if which == _PLAIN:
            line.put(self._keep * line.latest - self._gain * self._reconstruct(for_plain)[0])
        else:
            self._predictor.correct(open_loop, variance)
            left = self._predictor.ahead(line.delay_frames) + self._held[3]
            line.put(line.latest - self._clean(left)[0])

    def _complete(self) -> None:
        """Complete the previous frame: the other controller, the comparison, and what acts in this frame."""
        if self._rest is not None:
            open_loop, variance, for_plain, *left = self._rest
            self._rest = None
            self._follow(1 - self.chosen, open_loop, variance, for_plain)
            self._predictor.advance()
            learnt, plain = np.square(self._compare(*left), dtype=np.float64).sum(axis=1)
            self._choose((learnt - plain) / max(learnt + plain, 1e-30))
            self._held_at = -1
        if self._held_at != self._line.place:
            learnt_line, plain_line = self._lines
            acting = self._line.acting, learnt_line.acting, plain_line.acting
            self._held = self._product(*acting, learnt_line.latest, plain_line.latest)
            self._held_at = self._line.place


class _Product:
    """Product of a matrix with a few vectors, in float32; the matrix is read once."""

    def __init__(self, matrix: Floats) -> None:
        self._columns = np.ascontiguousarray(matrix.T, np.float32)

    def __call__(self, *vectors: Floats) -> Floats:
        """Return the products, (vectors, rows)."""
        out = np.zeros((len(vectors), self._columns.shape[1]), np.float32)
        _ADD_PRODUCTS(self._columns, np.array(vectors, np.float32), out)
        return out.astype(np.float64)


_ADD_PRODUCTS = Direct(add_products)
