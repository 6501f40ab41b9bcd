"""A night in minutes: a star that fades and comes back, seeing that comes and goes; does a loop tune itself?

The simulated loop, in stretches of a few seconds each: the star fades by 3 magnitudes until the middle of the
night and comes back, the seeing goes from 0.6 to 1.2 arcsec and back three times. Compared, on the same air:

- fixed settings: the best for the first stretch, chosen on other air;
- the fixed settings that turn out best for the whole night, which nobody can know beforehand;
- a loop that begins with the first ones, asks itself for advice in every stretch as
  `faintspot realtime advise --apply` does, tries it in turn with what it has, and keeps what leaves less.

The trials count; they take more than half of a stretch here, where they do not end early because what is
tried is worse. All follow the light. Some ten minutes on two processors that are free:

    python examples/night.py [--stretches 10] [--frames 1000] [--nights 2]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from faintspot.advice.centroid_gain import shifted_gain
from faintspot.advice.known import of_images
from faintspot.advice.proposals import Proposal, Sensor, new_estimators, new_gain
from faintspot.advice.residual import wavefront_modes
from faintspot.advice.seen import Seen
from faintspot.advice.simulated import frames_of_record, seen_in_record
from faintspot.advice.trial import compared
from faintspot.ao_loop import Arm, LoopConfiguration, load_loop, simulate_loop
from faintspot.ao_loop.calibration import flat_psf, reference_slopes
from faintspot.ao_loop.camera import camera_calibration
from faintspot.ao_loop.configuration import ARCSEC
from faintspot.ao_loop.observatory import prepare
from faintspot.control.learnt import Plant
from faintspot.experiments.statistics import mean_by_blocks
from faintspot.pipeline.settings import Settings

BRIGHTEST_E, FADES_BY = 1600.0, 3.0  # photo-electrons of a sub-aperture in a frame; magnitudes
SEEING_ARCSEC = 0.6, 1.2
GAINS = (0.2, 0.4, 0.6)
SETTLE, LEARN, TURN, IMAGES_EVERY = 60, 400, 60, 12  # frames
PLANNER_EVERY = 3  # stretches; the loop gain is looked at in all others
OTHER_AIR = 1200  # first realisation of the air on which the first settings are chosen


def night(stretches: int) -> list[LoopConfiguration]:
    """Return star and air of every stretch."""
    told = []
    for hour in (np.arange(stretches) + 0.5) / stretches:
        photons = BRIGHTEST_E * 10 ** (-0.4 * FADES_BY * math.sin(math.pi * hour) ** 2)
        low, high = SEEING_ARCSEC
        seeing = low + (high - low) * math.sin(3 * math.pi * hour) ** 2
        star = load_loop("camera_3e").replace("camera", photons_per_subaperture=photons)
        told.append(star.replace("atmosphere", r0_m=0.976 * 500e-9 / (seeing * ARCSEC)))
    return told


def arm(settings: Settings, gain: float, loop: LoopConfiguration) -> Arm:
    """Return an arm with some settings in the light of a stretch, which all follow."""
    if settings.estimator.uses_light:
        settings = settings.replace(flux_e=loop.photons)
    return Arm("-", settings, gain, correct_gain=False)


def fixed_settings(loop: LoopConfiguration) -> list[tuple[Settings, float]]:
    """Return what is tried as fixed settings: brightest pixels and a window, with a range of loop gains."""
    width = loop.scene.seen_fwhm_px
    kinds = [Settings("brightest", keep_brightest=30)]
    window = Settings("window", window_fwhm_px=2.8 * width, centroid_gain=1.0)
    return list(product([*kinds, with_gain(window, loop)], GAINS))


def with_gain(window: Settings, loop: LoopConfiguration) -> Settings:
    """Return a window with its centroid gain on the spots of a loop on other air."""
    tried = loop.replace("run", frames=300, settle_frames=SETTLE)
    record = simulate_loop(
        tried, [arm(Settings("brightest", keep_brightest=30), 0.3, loop)], realisation=OTHER_AIR
    )
    frames = frames_of_record(record, range(SETTLE, 300, IMAGES_EVERY))
    found = shifted_gain(sensor_of(loop, window).pipeline(window.replace(flux_e=loop.photons)), frames)
    assert found is not None
    return window.replace(centroid_gain=found.value)


def sensor_of(loop: LoopConfiguration, settings: Settings) -> Sensor:
    """Return what the loop's own configuration says of the sensor."""
    sensor = prepare(loop).sensor
    sizes: dict[str, Any] = {
        "subaperture_m": loop.subaperture_m,
        "pixel_scale_arcsec": loop.pixel_scale_rad / ARCSEC,
    }
    reference = reference_slopes(loop, sensor, Arm("-", settings)).astype(np.float64)
    psf = flat_psf(loop.spot_width_px, 1.0)
    return Sensor(replace(sensor.layout, **sizes), camera_calibration(loop), psf, None, reference)


def observed(loop: LoopConfiguration, frames: int, arms: list[Arm], schedule: Any, realisation: int) -> Any:
    """Run a stretch."""
    run = loop.replace("run", frames=frames, settle_frames=SETTLE)
    return simulate_loop(run, arms, schedule[:frames], realisation=realisation)


def fixed_strehl(
    choice: tuple[Settings, float], loop: LoopConfiguration, frames: int, realisation: int
) -> float:
    """Return the mean Strehl ratio of fixed settings in a stretch."""
    one = np.zeros(frames, np.int64)
    record = observed(loop, frames, [arm(*choice, loop)], one, realisation)
    return float(record.strehl[record.scored].mean())


def tuned_night(
    loops: list[LoopConfiguration], first: tuple[Settings, float], frames: int, offset: int
) -> Any:
    """Return the Strehl ratio in every stretch of the loop that tunes itself, and what it did."""
    settings, gain = first
    strehl, journal, waiting = [], [], list[Proposal]()
    for number, loop in enumerate(loops):
        sensor, present = sensor_of(loop, settings), arm(settings, gain, loop)
        optics, control = prepare(loop), loop.control
        plant = Plant(optics.interaction, optics.reconstructor, control.delay_frames, control.leak)
        modes, unit = wavefront_modes(sensor.layout)
        start = observed(loop, LEARN, [present], np.zeros(LEARN, np.int64), offset + number)
        seen = seen_in_record(start, [present])
        images = frames_of_record(start, range(SETTLE, LEARN, IMAGES_EVERY))
        shifted = shifted_gain(sensor.pipeline(present.settings), images)
        answers = 1.0 if shifted is None else shifted.value
        if number % PLANNER_EVERY == 1 and not waiting:
            waiting = planned(images, seen, sensor, present, answers)
        elif not waiting:
            found = new_gain(seen, plant, modes, gain, unit, answers)
            waiting = [] if found is None else [found]
        if not waiting:
            strehl.append(fixed_strehl((settings, gain), loop, frames, offset + number))
            continue
        proposal = waiting.pop(0)
        other = settings.replace(**proposal.changes), gain if proposal.gain is None else proposal.gain
        arms = [present, arm(*other, loop)]
        turns = np.concatenate([np.zeros(LEARN, np.int64), np.arange(frames) // TURN % 2])
        record = observed(loop, frames, arms, turns, offset + number)
        for end in range(LEARN + 4 * TURN, frames, 2 * TURN):
            better = verdict(record, arms, loop, modes, turns, end)
            if better.worse:  # it ends here, and the present settings have the rest
                turns[end:] = 0
                record = observed(loop, frames, arms, turns, offset + number)
                break
        else:
            end, better = frames, verdict(record, arms, loop, modes, turns, frames)
        journal.append(f"stretch {number}, {end - LEARN} frames: {proposal.text}: {better.in_words(unit)}")
        if better.kept:
            settings, gain = other
        strehl.append(float(record.strehl[record.scored].mean()))
    return np.array(strehl), journal


def planned(images: Any, seen: Seen, sensor: Sensor, present: Arm, answers: float) -> list[Proposal]:
    """Ask the planner, with what the images of a stretch tell."""
    known, psf = of_images(images, sensor.layout, sensor.calibration)
    residual, _ = seen.weighted([answers])
    rms = float(np.sqrt(np.median(np.square(residual).mean(axis=1))))
    return new_estimators(present.settings, sensor, images, known[0].value, psf, rms, answers)


def verdict(record: Any, arms: list[Arm], loop: LoopConfiguration, modes: Any, turns: Any, end: int) -> Any:
    """Say which of two arms in turn has left less before a frame."""
    whole = seen_in_record(record, arms)
    seen = whole.chosen(np.arange(len(whole)) < end - SETTLE)
    gains = []
    for number, each in enumerate(arms):
        own = [k for k in range(LEARN, end, IMAGES_EVERY) if turns[k] == number]
        pipeline = sensor_of(loop, each.settings).pipeline(each.settings)
        gains.append(shifted_gain(pipeline, frames_of_record(record, own)))
    same = arms[0].settings == arms[1].settings
    return compared(seen, modes, gains, same_settings=same)


def main() -> None:
    """Observe the nights and print what each way has had."""
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--stretches", type=int, default=10)
    options.add_argument("--frames", type=int, default=1000)
    options.add_argument("--nights", type=int, default=2)
    options.add_argument("--processes", type=int, default=2)
    given = options.parse_args()
    loops = night(given.stretches)
    choices = fixed_settings(loops[0])
    offsets = [given.stretches * number for number in range(given.nights)]
    with get_context("spawn").Pool(given.processes) as pool:
        work = [
            (choice, loops[0], given.frames, OTHER_AIR + 1 + air) for choice in choices for air in range(2)
        ]
        tried = np.array(pool.starmap(fixed_strehl, work, chunksize=1)).reshape(len(choices), 2).mean(axis=1)
        first = choices[int(np.argmax(tried))]
        tuned = pool.starmap_async(
            tuned_night, [(loops, first, given.frames, offset) for offset in offsets], chunksize=1
        )
        work = [
            (choice, loop, given.frames, offset + number)
            for choice in choices
            for offset in offsets
            for number, loop in enumerate(loops)
        ]
        fixed = np.array(pool.starmap(fixed_strehl, work, chunksize=1)).reshape(len(choices), -1)
        nights = tuned.get()
    own = np.concatenate([strehl for strehl, _ in nights])
    hindsight = int(np.argmax(fixed.mean(axis=1)))
    at_first = choices.index(first)
    for number, loop in enumerate(loops):
        words = "  ".join(f"{each[number]:.3f}" for each in (fixed[at_first], fixed[hindsight], own))
        print(f"{loop.photons:6.0f} e-, r0 {loop.atmosphere.r0_m:.3f} m: {words}")
    for number, (_, journal) in enumerate(nights):
        print(f"night {number + 1}")
        print("\n".join(f"  {line}" for line in journal))
    print("mean Strehl ratio, and what it is over the fixed settings (errors from blocks of three stretches)")
    for name, values in (
        (f"fixed, best for the first stretch ({in_words(first)})", fixed[at_first]),
        (f"fixed, best in hindsight ({in_words(choices[hindsight])})", fixed[hindsight]),
        ("tunes itself", own),
        ("the best of the fixed ones in every stretch, which nobody knows", fixed.max(axis=0)),
    ):
        over = mean_by_blocks(values - fixed[at_first], 3)
        print(f"  {values.mean():.3f}  {over.value:+.3f} +- {over.standard_error:.3f}  {name}")


def in_words(choice: tuple[Settings, float]) -> str:
    """Name settings and gain."""
    settings, gain = choice
    return f"{settings.estimator.name}, gain {gain:g}"


if __name__ == "__main__":
    main()
