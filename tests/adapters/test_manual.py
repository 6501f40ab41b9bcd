"""The scripts in the manual of other tools run as they stand, but for shorter recordings.

Filters learn from 350 to 450 frames. Strehl ratios are means of 100 frames or more, of one realisation, and
limits are wide; the stored results of foreign loops compare controls.
"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.shared_data import ROOT

MANUAL = ROOT / "docs" / "adapters"
STREHL = r"Strehl ratio ([\d.]+)"
SHORTER = {
    "hcipy": {"np.arange(100, 2250)": "np.arange(100, 600)", "np.arange(2250, 2950)": "np.arange(600, 850)"},
    "oopao": {"signal, 2150)": "signal, 600)", "run(predictive, 700)": "run(predictive, 250)"},
    "specula": {
        "total_time: 8.6": "total_time: 2.0",
        "total_time: 1.6": "total_time: 0.6",
        "override: {start_time: 0.6": "override: {start_time: 0.3",
    },
    "soapy": {"reconstruct, 900)": "reconstruct, 500)", "run(predictive, 400)": "run(predictive, 250)"},
    "pyrtc": {"8, 900, 50": "8, 500, 50", "size=2048": "size=1024"},
}
PYRAMIDS = ("specula",)
"""Pages whose third script replaces the lenslets by a pyramid, and runs after the others."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "module", "result", "low", "high"),
    [
        ("hcipy", "hcipy", STREHL, 0.2, 1.0),
        ("oopao", "OOPAO", STREHL, 0.5, 1.0),  # without a mirror 0.05
        ("specula", "specula", STREHL, 0.3, 1.0),
        ("soapy", "soapy", STREHL, 0.4, 1.0),
        ("pyrtc", "pyrtc", r"tilt left: \[ *([-\d.]+)", -0.2, 0.2),  # 0.8 px without a mirror
    ],
)
def test_scripts_close_their_loops_and_predictive_filters_drive_the_mirror(
    page: str, module: str, result: str, low: float, high: float, tmp_path: Path
) -> None:
    pytest.importorskip(module)
    text = (MANUAL / f"{page}.md").read_text(encoding="utf-8")
    closed, predictive, *more = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    pyramid = more[0] if page in PYRAMIDS else ""
    for length, shorter in SHORTER.get(page, {}).items():
        assert length in predictive
        predictive = predictive.replace(length, shorter)
    script = f"{closed}\n{predictive}\n{pyramid}"
    (tmp_path / "script.py").write_text(script, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=550, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = re.search(result, done.stdout)
    assert found is not None
    assert low < float(found[1]) < high
    compared = re.findall(r"integrator ([\d.]+), predictive filter ([\d.]+)", done.stdout)
    assert len(compared) == 1 + bool(pyramid)
    for before, after in np.array(compared, float):
        better = before - after if page == "pyrtc" else after - before  # rms slopes, or Strehl ratios
        assert better > -0.02  # of one realisation; Strehl ratios of other turbulence
    assert "centroid gain" in done.stdout
