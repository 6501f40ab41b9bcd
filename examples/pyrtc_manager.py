"""pyRTC's manager runs one of the files in examples/pyrtc, with faintspot's slopes; the loop is closed.

    python examples/pyrtc_manager.py examples/pyrtc/synthetic.yaml [SECTION.KEY=VALUE ...]

synthetic.yaml: pyRTC's synthetic sensor, our slopes process. telescope.yaml: the same on `faintspot realtime
telescope`. engine.yaml: pyRTC's sensor, and our engine as the source of the slopes. What a file needs beside
the manager (the telescope, the engine) is started here, and ended. Values change the file's:
slopes.class_name=pyrtc.SlopesProcess is pyRTC's own centroiding. Needs `pip install pyrtcao` and the extra
`realtime`, for the telescope `loop` as well.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pyrtc import clear_shms, open_stream
from pyrtc.manager import RTCManager

from faintspot.adapters.base import check_matrix

BENCH, COMMANDS, RATE_HZ = Path("bench"), 54, 100
TELESCOPE, ENGINE = "telescope", "engine"
STREAMS = ("wfs", "wfs_raw", "signal", "signal_2d", "wfc", "wfc_2d", "faintspot_commands")
SECONDS, PATIENCE_S = 8.0, 300.0
FAINTSPOT = [sys.executable, "-m", "faintspot", "realtime"]


@contextmanager
def beside(what: str) -> Iterator[None]:
    """Run what a file needs, while it is used."""
    started: list[subprocess.Popen[bytes]] = []
    try:
        if what == TELESCOPE:
            arguments = [
                "telescope",
                "run",
                "canary",
                "--frame-rate-hz",
                str(RATE_HZ),
                "--write-config",
                str(BENCH),
            ]
            started.append(subprocess.Popen([*FAINTSPOT, *arguments], stdin=subprocess.DEVNULL))
            wait_for("faintspot_frames")
        if what == ENGINE:
            configuration = Path(__file__).parent / "pyrtc" / "engine.toml"
            arguments = ["run", "--config", str(configuration), "--stream", "wfs_raw"]
            started.append(subprocess.Popen([*FAINTSPOT, *arguments], stdin=subprocess.DEVNULL))
            wait_for("faintspot_slopes")
        yield
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(PATIENCE_S)


def wait_for(name: str) -> None:
    """Wait for a stream."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        try:
            open_stream(name)
        except FileNotFoundError:
            time.sleep(0.2)
        else:
            return
    raise SystemExit(f"{name}: is not there")


def configured(path: Path, changes: list[str]) -> dict[str, Any]:
    """Read a file, and change some values."""
    document: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    for change in changes:
        place, value = change.split("=", 1)
        *sections, key = place.split(".")
        table = document
        for section in sections:
            table = table[section]
        table[key] = yaml.safe_load(value)
    return document


def calibrate(manager: RTCManager) -> None:
    """Give the loop an interaction matrix: measured without disturbance, or the telescope's."""
    loop, sensor, slopes = (manager.get_component(name) for name in ("loop", "wfs", "slopes"))
    if hasattr(sensor, "modal_amplitudes"):
        sensor.set_dark(np.full(sensor.dark.shape, sensor.background_level, sensor.dark.dtype))
        moving = sensor.modal_amplitudes.copy()
        sensor.modal_amplitudes[:] = 0.0
        loop.compute_im()
        sensor.modal_amplitudes[:] = moving
        check_matrix("interaction matrix", loop.im)
        return
    matrix, reference = (
        np.load(BENCH / f"{name}.npy") for name in ("interaction_matrix", "reference_slopes")
    )
    slopes.ref_slopes = np.zeros(slopes.valid_sub_aps.shape, np.float32)
    slopes.ref_slopes[illuminated()] = reference.ravel()
    loop.im = np.zeros((slopes.valid_sub_aps.size, COMMANDS), np.float32)
    loop.im[illuminated().ravel()] = matrix  # all 49 places, of which the telescope lights 36
    loop.compute_cm()


def illuminated() -> np.ndarray:
    """Which of pyRTC's places (x map above y map) the telescope lights."""
    import faintspot as fs

    cells = fs.Layout.load(BENCH / "faintspot.toml").cells
    valid = np.zeros((7, 7), bool)
    valid[cells[:, 0], cells[:, 1]] = True
    return np.concatenate([valid, valid])


def residual(manager: RTCManager) -> str:
    """What is left, as only a simulation knows it, over a few seconds."""
    values = []
    sensor = manager.get_component("wfs")
    truth = None if hasattr(sensor, "last_slope_signal") else open_stream("faintspot_truth")
    first, end = None if truth is None else truth.count, time.monotonic() + SECONDS
    while time.monotonic() < end:
        time.sleep(0.01)
        if truth is None:
            moved = sensor.slope_to_pixel_gain * sensor.last_slope_signal
            values.append(float(np.sqrt(np.square(moved).mean())))
        else:
            values.append(float(truth.read()[1]))
    if truth is None:
        return f"slopes, px rms {np.mean(values):.3f}"
    return f"Strehl ratio {np.mean(values):.3f} (frames {first} to {truth.count})"


def main() -> None:
    """Run a file: open, then closed."""
    path = Path(sys.argv[1])
    document = configured(path, sys.argv[2:])
    with beside(path.stem):
        manager = RTCManager.from_config(document, config_path=str(path))
        try:
            manager.build()
            for name in ("wfc", "wfs", "slopes"):
                manager.start_component(name)
            calibrate(manager)
            before = residual(manager)
            manager.start_component("loop")
            time.sleep(2.0)
            print(f"loop open: {before}; loop closed: {residual(manager)}", flush=True)
        finally:
            manager.close()
            clear_shms(STREAMS)


if __name__ == "__main__":
    main()
