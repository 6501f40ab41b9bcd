"""Best fit of a mirror to a wavefront, for tests of what a loop leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.simulation.wavefront_sensor import DeformableMirror, PupilAmplitude


@dataclass(frozen=True, eq=False)
class BestFit:
    """Best fit of a mirror to a known wavefront; its residual is the fitting error."""

    basis: NDArray[np.float32]
    """Orthonormal wavefronts of the mirror (and piston), weighted by the pupil, (points^2, n)."""
    weight: NDArray[np.float32]
    """Square root of the pupil's amplitude, (points^2,)."""

    @classmethod
    def of(cls, mirror: DeformableMirror, pupil: PupilAmplitude) -> BestFit:
        """Make the fit of a mirror, and of piston; it needs the full matrix, (points^2, commands)."""
        weight = np.sqrt(pupil.amplitude.ravel())
        flat = np.ones((len(weight), 1), np.float32)
        columns = np.hstack([mirror.matrix(), flat]) * weight[:, None]
        vectors, size, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(vectors[:, : np.count_nonzero(size > 1e-6 * size[0])], weight)

    def residual(self, wavefront: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return a wavefront (points, points) minus the mirror's best fit; 0 outside the pupil."""
        weighted = self.weight * wavefront.ravel()
        left = weighted - self.basis @ (self.basis.T @ weighted)
        inside = self.weight > 0
        residual = np.divide(left, self.weight, out=np.zeros_like(left), where=inside)
        return np.asarray(residual.reshape(wavefront.shape), np.float32)
