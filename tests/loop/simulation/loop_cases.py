"""Configurations of the tests of the loop: the default telescope, with air that does not change."""

import faintspot as fs
from faintspot.loop.simulation import LoopConfiguration, Method
from faintspot.loop.simulation.sections import Camera

PLAIN = fs.Settings("brightest", keep_brightest=80)


def quiet() -> LoopConfiguration:
    """Plenty of flux and no read noise."""
    return LoopConfiguration(camera=Camera(photons_per_subaperture=1e6, read_noise_e=0.0)).replace(
        "run", frames=200, settle_frames=40
    )


def faint() -> LoopConfiguration:
    """200 photons and 1 electron of read noise."""
    return quiet().replace("camera", photons_per_subaperture=200.0, read_noise_e=1.0)


def plain(label: str = "plain") -> Method:
    """Brightest pixels and centre of gravity."""
    return Method(label, PLAIN)
