"""Ctrl-C ends what waits in compiled code, where Python's own handlers do not run."""

import os
import signal
import threading

import numpy as np
import pytest

from faintspot.cli.realtime.engine_requests import stop_on_signal
from faintspot.slopes.kernels import streaming

pytestmark = pytest.mark.slow

PATIENCE_S = 20.0


def test_a_signal_comes_through_compiled_code() -> None:
    before = signal.getsignal(signal.SIGINT)
    cells, control, seen = np.zeros((2, 16), np.int64), np.zeros(1, np.int64), threading.Event()
    with stop_on_signal() as stop:

        def end_waiting() -> None:
            if stop.wait(PATIENCE_S):
                seen.set()
            control[0] = 1

        watcher = threading.Thread(target=end_waiting)
        watcher.start()
        threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()
        assert not streaming.wait_for_rows(cells, 0, 16, 1, 1, control, 0)  # frame 1 never comes
        watcher.join()
    assert seen.is_set()
    assert signal.getsignal(signal.SIGINT) is before
