"""pyRTC's camera and pyRTC's loop, with faintspot in between: frames one way, slopes the other.

    pyRTC WavefrontSensor --wfs_raw--> faintspot bridge, run --slopes--> pyRTC Loop --wfc--> WavefrontSensor

This script is the pyRTC side (`pip install pyrtcao`), and starts `faintspot realtime run` and `faintspot
realtime bridge` as processes of their own; all speak through shared memory. The sensor is a simulation: its
spots stand off the centres by a fixed tilt plus what the loop commands. The loop, an integrator on x and y
tilt, brings them back. With a file name (.npz) as argument, frames and slopes go there.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from pyrtc import Loop, WavefrontSensor, clear_shms, create_stream, open_stream

import faintspot as fs

NAME = f"pyrtc_example_{uuid4().hex[:6]}"
STREAMS = {stream: f"{NAME}_{stream}" for stream in ("wfs", "wfs_raw", "wfc")}
TILT_PX, RATE_HZ, SECONDS, LEVEL_ADU = np.array([0.8, -0.5]), 100.0, 3.0, 100
CONFIGURATION = f"""
[layout.grid]
shape = [7, 7]
pixels = 16
outer_radius = 3.5
inner_radius = 0.5

[estimator]
name = "tv"
noise_std = 2.0
keep_brightest = 12

[calibration]
dark = {LEVEL_ADU}
read_noise_e = 2.0
"""


class Sensor(WavefrontSensor):
    """A camera of pyRTC's: `expose` runs in a thread of the component's."""

    def __init__(self, layout: fs.Layout) -> None:
        height, width = layout.frame_shape
        super().__init__(
            {"width": width, "height": height, "output_streams": STREAMS, "functions": ["expose"]}
        )
        self.layout, self.rng = layout, np.random.default_rng(1)
        self.commands = open_stream(STREAMS["wfc"])
        self.sent: dict[int, np.ndarray] = {}

    def expose(self) -> None:
        """Publish a frame, stamped with its number."""
        tilt = TILT_PX + self.commands.read()
        frames, _ = fs.slopes.simulate.sensor_frames(
            self.layout,
            1,
            flux_e=300.0,
            positions=np.broadcast_to(tilt, (1, len(self.layout), 2)),
            detector=fs.slopes.simulate.Detector(2.0, offset_adu=LEVEL_ADU, bits=16),
            rng=self.rng,
        )
        self.data = frames[0]
        super().expose()
        self.sent[self.frame_id] = self.data
        time.sleep(1 / RATE_HZ)


@contextmanager
def engine(folder: str) -> Iterator[None]:
    """Run faintspot: the bridge follows the sensor's raw frames, the engine measures them."""
    command = [sys.executable, "-m", "faintspot", "realtime"]
    run = ["run", "--name", NAME, "--config", f"{folder}/faintspot.toml"]
    processes = [
        subprocess.Popen([*command, *arguments])
        for arguments in (run, ["bridge", STREAMS["wfs_raw"], "--name", NAME])
    ]
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.wait()


def slopes_stream() -> Any:
    """Open the stream of slopes, once frames are measured; the engine may have to compile."""
    for _ in range(1800):
        try:
            stream = open_stream(f"{NAME}_slopes")
        except FileNotFoundError:
            stream = None
        if stream is not None and stream.count:
            return stream
        time.sleep(0.1)
    raise SystemExit("no slopes within three minutes")


def main() -> None:
    """Close the loop for a few seconds and say what is left of the tilt."""
    received: dict[int, np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "faintspot.toml").write_text(CONFIGURATION)
        layout = fs.Layout.load(Path(folder) / "faintspot.toml")
        commands = create_stream(STREAMS["wfc"], (2,), np.float32)
        commands.write(np.zeros(2, np.float32))
        sensor, loop = Sensor(layout), None
        try:
            with engine(folder):
                sensor.start()
                stream = slopes_stream()
                loop = Loop(
                    {
                        "gain": 0.2,
                        "functions": ["standard_integrator"],
                        "input_streams": {"signal": f"{NAME}_slopes"},
                        "output_streams": {"wfc": STREAMS["wfc"]},
                    }
                )
                loop.im = np.kron(np.eye(2, dtype=np.float32), np.ones((len(layout), 1), np.float32))
                loop.compute_cm()
                closing = time.monotonic() + 1.0  # a second without correction, for comparison
                end = closing + SECONDS
                while time.monotonic() < end:
                    publication = stream.read_after_publication(stream.last_read_count, timeout=10.0)
                    received[publication.frame_id] = np.array(publication.payload)
                    if time.monotonic() > closing and not loop.running:
                        loop.start()
        finally:
            sensor.close()
            if loop is not None:
                loop.close()
            clear_shms(STREAMS.values())
    frames, slopes = list(received), np.array(list(received.values()))
    tilt = slopes.reshape(len(slopes), 2, -1).mean(axis=2)
    for what, part in (("open", tilt[:20]), ("closed", tilt[-20:])):
        x, y = part.mean(axis=0)
        print(f"loop {what}: mean slope {x:+.3f}, {y:+.3f} px")
    if len(sys.argv) > 1:
        np.savez(sys.argv[1], frames=[sensor.sent[number] for number in frames], slopes=slopes, tilt=tilt)


if __name__ == "__main__":
    main()
