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
        ("hcipy", "hcipy", r"Strehl ratio ([\d.]+)", 0.2, 1.0),
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
    found = re.search(result, _output(page, 1, tmp_path))
    assert found is not None
    assert low < float(found[1]) < high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "module"), [("oopao", "OOPAO"), ("hcipy", "hcipy"), ("specula", "specula"), ("soapy", "soapy")]
)
def test_predictive_filters_drive_the_mirror(page: str, module: str, tmp_path: Path) -> None:
    pytest.importorskip(module)
    output = _output(page, 2, tmp_path)
    before, after = map(float, re.findall(r"integrator ([\d.]+), predictive filter ([\d.]+)", output)[0])
    assert after > before - 0.02  # of one realisation, other turbulence
    assert "centroid gain" in output


def _output(page: str, blocks: int, folder: Path) -> str:
    """Return what the first blocks of a page print, as one script."""
    text = (MANUAL / f"{page}.md").read_text(encoding="utf-8")
    scripts = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[:blocks]
    assert len(scripts) == blocks
    (folder / "script.py").write_text("\n".join(scripts), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=folder, capture_output=True, text=True, timeout=550, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout
