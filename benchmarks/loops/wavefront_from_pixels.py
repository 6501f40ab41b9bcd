"""The wavefront straight from all pixels, without slopes in between: what it could give, and what it gives.

A spot that turbulence has speckled says more of the wavefront than where it is. The phase over all
sub-apertures, in Karhunen-Loeve modes of von Karman turbulence, is fitted to the pixels of a frame by
Fisher scoring of the posterior (shifted Poisson likelihood, known light). Beside it stands what no
estimator can beat on average, the Bayesian Cramer-Rao bound (Van Trees 1968, Detection, Estimation and
Modulation Theory I, 2.4): the inverse of the mean Fisher information and the prior's. Errors are those in
the mirror's space, nm rms.

    python -m benchmarks.loops.wavefront_from_pixels open camera_3e 200     one frame
    python -m benchmarks.loops.wavefront_from_pixels closed diffraction_limit 20     corrects the filter

In closed loop, the prior is the Kalman filter's prediction (and turbulence that slopes do not see), the
mirror is known, and the fit corrects the filter's state; the same filter corrected by the slopes of a fixed
window is run on the same air. 250 modes, a fifth of a second a frame.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from faintspot.experiments.closed_loop.results import with_choice
from faintspot.loop.control.kalman.predictor import SlopePredictor
from faintspot.loop.simulation import LoopConfiguration, Method, load_loop, simulate_loop
from faintspot.loop.simulation.learning import learnt_control
from faintspot.loop.simulation.simulation import _Loop
from faintspot.loop.simulation.telescope import LoopOptics, TelescopeModel, prepare
from faintspot.loop.slope_covariance import phase_covariance_rad2

Floats = NDArray[np.float64]

MODES, LOCAL_MODES = 250, 28
STEPS_OPEN, STEPS_CLOSED = 12, 3
FRAMES = 40
WINDOW_FWHM, LOOP_GAIN, NOISE_SCALE = 1.5, 0.2, 0.6  # lambda / d; as tuned on other air


class Pixels:
    """Images of phases in local modes of each sub-aperture, their likelihood and its derivatives."""

    def __init__(self, optics: LoopOptics, configuration: LoopConfiguration, local: Floats) -> None:
        sensor = optics.sensor
        self.amplitude = sensor.amplitude.astype(np.float64)
        axes = sensor.image_y, sensor.image_x
        self.rows, self.columns = (axis.transform.astype(np.complex128) for axis in axes)
        self.to_pixels = tuple(axis.to_pixels.astype(np.float64) for axis in axes)
        self.radians = 2e-9 * np.pi / sensor.wavelength_m
        self.flux, self.variance = configuration.photons, configuration.camera.read_noise_e**2
        self.local = local
        """(points of a sub-aperture, local modes)"""

    def images(self, phase_nm: Floats) -> tuple[Floats, NDArray[Any], NDArray[Any]]:
        """Return mean images (n, pixels, pixels) of phases (n, s, s), fields and amplitudes at the camera."""
        field = self.amplitude * np.exp(1j * self.radians * phase_nm)
        seen = self.rows @ field @ self.columns.T
        row, column = self.to_pixels
        return self.flux * (row @ (seen.real**2 + seen.imag**2) @ column.T), field, seen

    def likelihood(self, modes: Floats, around_nm: Any, taken: Floats) -> tuple[float, Floats, Floats]:
        """Return the log likelihood of images, its gradient (n, m) and its information (n, m, m)."""
        n, samples = self.amplitude.shape[:2]
        image, field, seen = self.images((modes @ self.local.T).reshape(n, samples, samples) + around_nm)
        shapes = self.local.T.reshape(1, -1, samples, samples)
        change = self.rows @ ((1j * field)[:, None] * shapes @ self.columns.T)
        row, column = self.to_pixels
        slope = row @ (np.conj(seen)[:, None] * change).real @ column.T
        slope = (2 * self.radians * self.flux * slope).reshape(n, shapes.shape[1], -1)
        expected = np.maximum(image, 0).reshape(n, -1) + self.variance
        measured = taken.reshape(n, -1) + self.variance
        weighted = slope / expected[:, None]
        gradient = np.matmul(weighted, (measured - expected)[:, :, None])[:, :, 0]
        value = float((measured * np.log(expected) - expected).sum())
        return value, gradient, np.matmul(weighted, slope.swapaxes(1, 2))


@dataclass
class Model:
    """Wavefronts in Karhunen-Loeve modes, and what pixels, slopes and the mirror make of them."""

    optics: LoopOptics
    pixels: Pixels
    points: tuple[NDArray[np.int64], NDArray[np.int64]]
    """Rows and columns of the points of all sub-apertures, (n, points)."""
    modes: Floats
    """(n points, MODES), nm"""
    power: Floats
    """Variances of the modes, nm^2."""
    local: Floats
    """The modes in each sub-aperture's own, (n LOCAL_MODES, MODES)."""
    slopes: Floats
    """(2 n, MODES) px"""
    mirror: Floats
    """From modes to coordinates of the mirror's space, nm rms."""

    @classmethod
    def of(cls, configuration: LoopConfiguration) -> Model:
        """Compute the modes of a configuration's turbulence."""
        optics, samples = prepare(configuration), configuration.sensor.samples
        sensor, cells = optics.sensor, optics.sensor.layout.cells
        row, column = (part.ravel() for part in np.mgrid[:samples, :samples])
        points = cells[:, :1] * samples + row, cells[:, 1:] * samples + column
        step = configuration.width_m / sensor.points
        atmosphere = configuration.atmosphere
        places = np.column_stack([points[1].ravel(), points[0].ravel()]) * step
        covariance = phase_covariance_rad2(places, float(np.mean(atmosphere.r0_m)), atmosphere.outer_scale_m)
        power, modes = eigsh(covariance * (500 / (2 * np.pi)) ** 2, MODES)
        blocks = modes.reshape(len(cells), -1, MODES)
        _, own = np.linalg.eigh(np.einsum("nak,k,nbk->ab", blocks, power, blocks))
        own = own[:, ::-1][:, :LOCAL_MODES]
        whole = np.zeros((sensor.points, sensor.points))
        slopes = []
        for mode in modes.T:
            whole[points[0].ravel(), points[1].ravel()] = mode
            slopes.append(sensor.mean_slopes_px(whole))
        weight = optics.pupil.amplitude[points[0].ravel(), points[1].ravel()].astype(np.float64)
        weight /= weight.sum()
        surface = optics.mirror.matrix()[points[0].ravel() * sensor.points + points[1].ravel()].astype(
            np.float64
        )
        surface = (surface - weight @ surface) * np.sqrt(weight)[:, None]
        basis, size, _ = np.linalg.svd(surface, full_matrices=False)
        basis = basis[:, size > 1e-6 * size[0]] * np.sqrt(weight)[:, None]
        return cls(
            optics,
            Pixels(optics, configuration, own),
            points,
            modes,
            power,
            np.einsum("am,nak->nmk", own, blocks).reshape(-1, MODES),
            np.array(slopes).T,
            basis.T @ (modes - weight @ modes),
        )

    def information(self, local: Floats) -> Floats:
        """Return the information (MODES, MODES) of that of each sub-aperture."""
        blocks = self.local.reshape(*local.shape[:2], MODES)
        return np.asarray(self.local.T @ np.matmul(local, blocks).reshape(self.local.shape))

    def fit(
        self,
        taken: Floats,
        mean: Floats,
        inverse: Floats,
        start: Floats,
        around_nm: Any = 0.0,
        steps: int = 12,
    ) -> tuple[Floats, Floats]:
        """Return the most probable modes near a start, and the inverse of their covariance there."""
        best: tuple[float, Floats, Floats] | None = None
        step, modes = np.zeros(MODES), start
        for _ in range(steps + 1):
            value, gradient, local = self.pixels.likelihood(
                (self.local @ modes).reshape(len(taken), -1), around_nm, taken
            )
            value -= 0.5 * float((modes - mean) @ inverse @ (modes - mean))
            if best is not None and value < best[0]:
                step = 0.4 * step
            else:
                posterior = self.information(local) + inverse
                best = value, modes, posterior
                slope = self.local.T @ gradient.ravel() - inverse @ (modes - mean)
                step = np.asarray(np.linalg.solve(posterior, slope), np.float64)
            modes = best[1] + step
        assert best is not None
        return best[1:]

    def taken(self, frame: NDArray[Any]) -> Floats:
        """Return the images of a frame, (n, pixels, pixels); these cameras count electrons."""
        height, width = self.optics.sensor.layout.window
        corners = self.optics.sensor.layout.corners
        return np.array([frame[r : r + height, c : c + width] for r, c in corners], np.float64)

    def in_mirror(self, covariance: Floats) -> float:
        """Return the rms in the mirror's space of modes with a covariance, nm."""
        return float(np.sqrt(np.trace(self.mirror @ covariance @ self.mirror.T)))


def from_slopes(model: Model, noise_px: float) -> tuple[Floats, Floats]:
    """Return the linear estimator (MODES, 2 n) from slopes with such noise, and its error's covariance."""
    seen = model.slopes * model.power
    total = seen @ model.slopes.T + (noise_px**2 + 1e-9) * np.eye(len(seen))
    matrix = np.asarray(np.linalg.solve(total, seen).T, np.float64)
    return matrix, np.diag(model.power) - matrix @ seen


def open_loop(configuration: LoopConfiguration) -> None:
    """Print the errors of one frame's estimates, without a prediction, and the bound."""
    model, telescope_model = Model.of(configuration), TelescopeModel(configuration, 77)
    rng, inverse = np.random.default_rng(3), np.diag(1 / model.power)
    start, rough = from_slopes(model, 0.43)
    perfect, no_noise = from_slopes(model, 0.0)
    information, errors = np.zeros((MODES, MODES)), []
    for frame in range(FRAMES):
        wavefront, _ = telescope_model.wavefronts(7.3 * frame, np.zeros(model.optics.mirror.commands))
        truth = model.modes.T @ wavefront[model.points].ravel().astype(np.float64)
        slopes = model.optics.sensor.mean_slopes_px(wavefront)
        taken = model.taken(telescope_model.frame(frame, wavefront))
        begin = start @ (slopes + rng.normal(0, 0.43, len(slopes)))
        zero = np.zeros(MODES)
        found = [model.fit(taken, zero, inverse, each, steps=STEPS_OPEN)[0] for each in (begin, truth)]
        tried = [perfect @ slopes, begin, *found]
        errors.append([np.linalg.norm(model.mirror @ (each - truth)) for each in tried])
        local = (model.local @ truth).reshape(len(taken), -1)
        information += model.information(model.pixels.likelihood(local, 0.0, taken)[2]) / FRAMES
    rms = np.sqrt(np.square(errors).mean(axis=0))
    spread = np.square(errors).std(axis=0, ddof=1) / np.sqrt(FRAMES) / (2 * rms)
    flux = f"{configuration.photons:g} photo-electrons, {FRAMES} frames"
    print(f"{configuration.name}, {flux}; nm rms in the mirror's space")
    bound = model.in_mirror(np.asarray(np.linalg.inv(information + inverse), np.float64))
    print(f"  {'bound (Van Trees)':40s} {bound:6.1f}")
    titles = (
        "true slopes",
        "slopes with 0.43 px of noise",
        "pixels, from those slopes",
        "pixels, from the truth",
    )
    for title, value, error in zip(titles, rms, spread, strict=True):
        print(f"  {title:40s} {value:6.1f} +- {error:.1f}")
    print(f"  expected of the slopes: {model.in_mirror(no_noise):.1f}, {model.in_mirror(rough):.1f}")


class PixelLoop(_Loop):
    """The loop with a Kalman filter that pixels correct."""

    def begin(self, model: Model, predictor: SlopePredictor) -> None:
        """Take a filter; the modes' prior is its prediction, and what slopes do not tell."""
        self.model, self.predictor = model, predictor
        self.from_slopes, hidden = from_slopes(model, 1e-3)
        spread = hidden + self.from_slopes @ predictor.predicted_px2 @ self.from_slopes.T
        self.inverse = np.linalg.inv(spread + 1e-6 * np.trace(spread) / MODES * np.eye(MODES))
        self.to_state = np.linalg.solve(predictor.predicted_px2, predictor.with_slopes.T).T
        ahead = predictor.model.ahead(self.line.delay_frames)
        self.command = -self.optics.reconstructor.clean @ ahead

    def step(self, frame: int) -> None:
        """Simulate one frame."""
        model, commands = self.model, self.line.acting
        time = (frame + 0.5) / self.configuration.control.frame_rate_hz
        after, seen = self.telescope_model.wavefronts(time, commands)
        self._observe(frame, time, after)
        mean = self.from_slopes @ self.predictor.mean_px
        samples = self.configuration.sensor.samples
        mirror = self.optics.mirror.wavefront_nm(commands)[model.points].reshape(-1, samples, samples)
        taken = model.taken(self.telescope_model.frame(frame, seen))
        found, _ = model.fit(taken, mean, self.inverse, mean, mirror, STEPS_CLOSED)
        self.predictor.state += self.to_state @ (model.slopes @ (found - mean))
        self.line.put(self.command @ self.predictor.state)
        self.predictor.advance()


def closed_loop(configuration: LoopConfiguration, realisations: int) -> None:
    """Print Strehl ratios of the filter that slopes correct, and of the one that pixels correct."""
    width = WINDOW_FWHM * configuration.spot_width_px
    choice = {"loop_gain": LOOP_GAIN, "noise_scale": NOISE_SCALE, "window_fwhm_px": width}
    method = with_choice(Method.named("window+kalman"), configuration, choice)
    method, learnt = learnt_control(configuration, method, configuration.run.seed, simulate_loop)
    assert learnt is not None
    model, settle = Model.of(configuration), configuration.run.settle_frames
    print(f"{configuration.name}, {configuration.photons:g} photo-electrons, filter: {learnt.description}")
    found = []
    for realisation in range(realisations):
        which, numbers = np.zeros(configuration.run.frames, np.int64), np.arange(configuration.run.frames)
        what = configuration, [(method, learnt)], which, configuration.run.seed, realisation, numbers
        by_slopes, by_pixels = _Loop(*what), PixelLoop(*what)
        predictor = learnt.predictor()
        assert isinstance(predictor, SlopePredictor)
        by_pixels.begin(model, predictor)
        found.append([each.run(None).rows["strehl"][settle:].mean() for each in (by_slopes, by_pixels)])
        print(
            f"  Strehl ratio corrected by slopes {found[-1][0]:.3f}, by pixels {found[-1][1]:.3f}", flush=True
        )
    gain = np.diff(found, axis=1)[:, 0]
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else np.nan
    print(f"  pixels - slopes: {gain.mean():+.3f} +- {error:.3f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("loop", choices=["open", "closed"])
    parser.add_argument("configuration")
    parser.add_argument("photons", type=float)
    parser.add_argument("--frames", type=int, default=700)
    parser.add_argument("--realisations", type=int, default=3)
    options = parser.parse_args()
    asked = load_loop(options.configuration).replace("camera", photons_per_subaperture=options.photons)
    if options.loop == "open":
        open_loop(asked)
    else:
        closed_loop(asked.replace("run", frames=options.frames), options.realisations)
