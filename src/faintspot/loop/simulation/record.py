"""Record of a closed-loop run: telemetry, true values and control; folders of results."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import NpzFile
from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import TRUE, WEIGHTED, Method
from faintspot.loop.simulation.sections import CLOSED
from faintspot.loop.simulation.telescope import LoopOptics
from faintspot.loop.slope_covariance import SlopeTurbulence

if TYPE_CHECKING:
    from faintspot.loop.control.identification.model import Kalman
    from faintspot.loop.control.integrator import LoopPlant


@dataclass(frozen=True, eq=False)
class LoopRecord(NpzFile):
    """One run of `simulate_loop`, n sub-apertures and m commands."""

    WHAT: ClassVar[str] = "a record of a loop"
    FORMAT: ClassVar[int] = 5

    slopes_px: NDArray[np.float32]
    """(frames, 2 n): all x, then all y, from the reference, before division by a centroid gain."""
    valid: NDArray[np.bool_]
    """(frames, n)"""
    standard_error_px: NDArray[np.float32]
    """(frames, 2 n); infinite where invalid or unknown."""
    covariance_xy_px2: NDArray[np.float32]
    """(frames, n): covariance of the errors of x and y."""
    commands: NDArray[np.float32]
    """(frames, m): commands that acted during each frame [nm]."""
    strehl: NDArray[np.float64]
    """(frames,): Strehl ratio of each frame at the science wavelength, on axis."""
    residual_nm: NDArray[np.float64]
    """(frames,): rms of the residual wavefront."""
    r0_m: NDArray[np.float64]
    """(frames,): true Fried parameter at 500 nm."""
    method: NDArray[np.int8]
    """(frames,): number of the method that measured the frame."""
    interaction_matrix: NDArray[np.float64]
    """(2 n, m): displacements of the spots, true px, for a command of 1 nm."""
    centroid_gain: NDArray[np.float64]
    """(methods,): centroid gain of each method at the run's flux."""
    corrected: NDArray[np.bool_]
    """(methods,): whether slopes were divided by the centroid gain: this one, or one that control learnt."""
    labels: tuple[str, ...]
    """Labels of the methods."""
    method_settings: tuple[str, ...]
    """Settings of each method as TOML."""
    cells: NDArray[np.int64]
    """(n, 2): row and column of each sub-aperture in the lenslet array."""
    illumination: NDArray[np.float64]
    """(n,): illuminated fraction of each sub-aperture."""
    configuration: str
    """Configuration as TOML."""
    seed: int
    realisation: int

    @cached_property
    def loop(self) -> LoopConfiguration:
        """Configuration of the run."""
        return LoopConfiguration.from_text(self.configuration)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.strehl)

    @property
    def scored(self) -> NDArray[np.bool_]:
        """(frames,): whether a frame comes after settling."""
        return np.arange(self.frames) >= self.loop.run.settle_frames

    def mean_strehl(self, method: int = 0) -> float:
        """Return the long-exposure Strehl ratio of a method: the mean of its frames after settling.

        Raises
        ------
        InputError
            When the method has no such frame.
        """
        chosen = self.scored & (self.method == method)
        if not chosen.any():
            settling = self.loop.run.settle_frames
            raise InputError(f"method = {method}: no frame after the {settling} settling ones")
        return float(self.strehl[chosen].mean())


MAGNITUDE_FILE = "magnitude.npz"
"""Name of the file in a folder of results."""


def holds_loop_results(path: Path) -> bool:
    """Return whether a folder holds results of `faintspot loop`."""
    return (path / MAGNITUDE_FILE).is_file()


def make_folder(folder: str | Path) -> Path:
    """Make a folder if it does not exist, and return its path.

    Raises
    ------
    InputError
        When it cannot be made.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError:
        raise InputError(f"{folder}: the folder {folder.parent} does not exist: create it first") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror or error})") from None
    return folder


def make_controller(
    configuration: LoopConfiguration,
    optics: LoopOptics,
    method: Method,
    learnt: Kalman | None,
    line: CommandDelayLine,
) -> Controller:
    """Return the controller of a method, which sends its commands to `line`."""
    if learnt is not None:
        std_px = method.prior_std_px(len(optics.interaction))
        return learnt.guarded(plant_of(configuration, optics), line, prior_std_px=std_px)
    control = configuration.control
    return Integrator(
        line,
        optics.interaction,
        optics.reconstructor,
        control.gain if method.gain is None else method.gain,
        control.leak,
        weighted=WEIGHTED in method.variants and TRUE not in method.variants,
        sees_mirror=control.mode == CLOSED,
    )


def slope_turbulence(configuration: LoopConfiguration, cells: NDArray[np.int64]) -> SlopeTurbulence:
    """Return the theory of slopes in turbulence with the assumed winds."""
    atmosphere = configuration.atmosphere
    angle = np.deg2rad(atmosphere.wind_direction_deg)
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    return SlopeTurbulence(
        cells[:, ::-1].astype(np.float64) * configuration.subaperture_m,
        configuration.subaperture_m,
        configuration.pixel_scale_rad,
        float(np.mean(atmosphere.r0_m)),
        atmosphere.outer_scale_m,
        np.array(atmosphere.fraction),
        np.array(atmosphere.wind_speed_m_per_s, np.float64)[:, None] * around,
    )


def plant_of(configuration: LoopConfiguration, optics: LoopOptics) -> LoopPlant:
    """Return the loop for which controllers are learnt."""
    from faintspot.loop.control.integrator import LoopPlant  # an integrator needs no replays

    control = configuration.control
    return LoopPlant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)
