"""Controller of a method."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import CommandDelayLine, Controller
from faintspot.loop.control.integrator import Integrator
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.loop.simulation.methods import TRUE, WEIGHTED, Method
from faintspot.loop.simulation.telescope.model import LoopOptics
from faintspot.loop.turbulence.slope_covariance import SlopeTurbulence

if TYPE_CHECKING:
    from faintspot.loop.control.identification.model import Kalman
    from faintspot.loop.control.plant import LoopPlant


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
    atmosphere, control = configuration.atmosphere, configuration.control
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
    ).turned(control.assumed_wind_factor, control.assumed_wind_turn_deg)


def plant_of(configuration: LoopConfiguration, optics: LoopOptics) -> LoopPlant:
    """Return the loop for which controllers are learnt."""
    from faintspot.loop.control.plant import LoopPlant  # an integrator needs no replays

    control = configuration.control
    return LoopPlant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)
