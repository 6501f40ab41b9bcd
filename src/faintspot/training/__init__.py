"""Learning from spots: the trained linear score, and the point-spread function."""

from faintspot.training.psf_learning import LearntPSF, learn_psf, learn_psf_from_images
from faintspot.training.recorded import train_from_frames
from faintspot.training.running_psf import RunningPSF
from faintspot.training.simulation import train_estimator

__all__ = [
    "LearntPSF",
    "RunningPSF",
    "learn_psf",
    "learn_psf_from_images",
    "train_estimator",
    "train_from_frames",
]
