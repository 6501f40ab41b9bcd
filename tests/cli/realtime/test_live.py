import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

pytest.importorskip("tornado")
pytest.importorskip("pyshmem")
pytest.importorskip("zarr")

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "faintspot", "live"]


def refused(*arguments: str) -> str:
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_what_cannot_be_shown_is_one_line() -> None:
    assert "expected an IP address" in refused("--bind", "everywhere", "--port", "0")
    assert "name = '../x'" in refused("--name", "../x", "--port", "0")


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_page_is_served_until_it_is_ended(tmp_path: Path, end: signal.Signals) -> None:
    command = [*COMMAND, "--name", "fs_test_live", "--port", "0"]  # whose engine has not started
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url, _, token = process.stdout.readline().strip().partition("#")
            assert len(token) >= 32
            with urllib.request.urlopen(url) as page:
                assert b"<title>faintspot</title>" in page.read()
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "example.org"}))
            process.send_signal(end)
            assert process.wait(60) == 0
        finally:
            process.kill()
