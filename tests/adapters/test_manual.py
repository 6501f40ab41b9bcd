"""The scripts in the manual of other tools run as they stand, in a process of their own."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from tests.shared_data import ROOT

MANUAL = ROOT / "docs" / "adapters"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "module", "result", "low", "high"),
    [
        ("oopao", "OOPAO", r"Strehl ratio ([\d.]+)", 0.5, 1.0),  # without a mirror 0.05
        ("specula", "specula", r"Strehl ratio ([\d.]+)", 0.3, 1.0),
        ("soapy", "soapy", r"Strehl ratio ([\d.]+)", 0.4, 1.0),
        ("pyrtc", "pyrtc", r"tilt left: \[ *([-\d.]+)", -0.2, 0.2),  # 0.8 px without a mirror
    ],
)
def test_scripts_close_their_loops(
    page: str, module: str, result: str, low: float, high: float, tmp_path: Path
) -> None:
    pytest.importorskip(module)
    text = (MANUAL / f"{page}.md").read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert script is not None
    (tmp_path / "script.py").write_text(script[1], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = re.search(result, done.stdout)
    assert found is not None, done.stdout[-500:]
    assert low < float(found[1]) < high
