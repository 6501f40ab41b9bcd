"""Options of the table [control] of faintspot.toml, and those of any integrator."""

from dataclasses import dataclass

from faintspot.base.options import Options, setting
from faintspot.loop.control.base import CONTROLS, INTEGRATOR

TABLE = "control"
NO_MODES, TIP_TILT, TIP_TILT_FOCUS = "none", "tip_tilt", "tip_tilt_focus"
REMOVED_MODES = NO_MODES, TIP_TILT, TIP_TILT_FOCUS
NONE, CONTROLLER, STREAM = "none", "controller", "stream"
"""Sources of predictions."""
BEYOND_ALL = 1e30
"""Largest command without a limit: finite in float32, too."""


@dataclass(frozen=True, eq=False)
class IntegratorOptions(Options, table=TABLE):
    """Options of an integrator, of the engine and of the simulated telescope."""

    gain: float = setting(0.4, "Loop gain of the integrator.", low=0, high=2)
    leak: float = setting(0.01, "Fraction by which commands decay in each frame.", low=0, high=1)
    delay_frames: int = setting(
        2,
        "Delay: the command computed from frame k first acts during the exposure of frame k + delay_frames.",
        low=1,
        high=100,
        whole=True,
    )
    largest_condition: float = setting(
        30.0,
        "Largest condition number of the reconstructor: modes of the mirror with smaller singular values are "
        "not controlled.",
        low=1,
        high=1e6,
    )


@dataclass(frozen=True, eq=False)
class ControlOptions(IntegratorOptions):
    """Options of the table [control]."""

    controller: str = setting(
        INTEGRATOR,
        "Controller that turns slopes into commands; all but the integrator need a `model`.",
        choices=tuple(CONTROLS),
    )
    largest_command: float | None = setting(
        None,
        "Stroke limit, in the unit of the interaction matrix; clipped commands do not accumulate "
        "(anti-windup). Default: no limit.",
        low=0,
        high=BEYOND_ALL,
        low_open=True,
    )
    centroid_gain: float = setting(
        1.0,
        "Centroid gain relative to the interaction matrix; slopes are divided by it. 1 for a matrix measured "
        "with the same estimator at the same flux.",
        low=0.01,
        high=100,
    )
    removed_modes: str = setting(
        REMOVED_MODES[0],
        'Modes that slopes of a laser guide star do not show: "tip_tilt" or "tip_tilt_focus". They are '
        "removed before reconstruction and are not controlled; for integrators.",
        choices=REMOVED_MODES,
    )
    prediction: str | None = setting(
        None,
        'Source of the predicted slopes for estimators with a prior: "controller"; "stream", another program '
        'by the stream NAME_prediction; or "none". Default: "controller" for a Kalman filter, else "none".',
        choices=(NONE, CONTROLLER, STREAM),
    )
    learn_every_s: float = setting(
        10.0,
        "Time between two learnings of a Kalman filter while the engine runs, each from the telemetry since "
        "the one before; 0: never.",
        unit="s",
        low=0,
        high=3600,
    )
    guard_frames: int = setting(
        50, "Number of frames over which the guard averages.", low=1, high=1_000_000, whole=True
    )
    most_invalid: float = setting(
        0.5, "Fraction of invalid slopes above which the guard opens the loop; 1: never.", low=0, high=1
    )
    largest_residual_px: float | None = setting(
        None,
        "Rms of the slopes above which the guard opens the loop. Default: 1.25 times the open-loop rms, if "
        "the loop was open for `guard_frames` before; else a quarter of a window's side.",
        unit="px",
        low=0,
        high=BEYOND_ALL,
        low_open=True,
    )
    most_at_limit: float = setting(
        0.5,
        "Fraction of commands at `largest_command` above which the guard opens the loop; 1: never.",
        low=0,
        high=1,
    )
    proven_frames: int = setting(
        1000,
        "Number of frames after which a closed loop counts as proven. If the guard opens a proven loop, it "
        "closes it again after `guard_frames`, with a learnt controller's integrator; 0: never.",
        low=0,
        high=1_000_000,
        whole=True,
    )
