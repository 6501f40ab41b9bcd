import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from tests.experiments.night_cases import night_with, without_r0

from faintspot.experiments.night.analysis import differences
from faintspot.experiments.night.page import night_summary, night_summary_text, write_night

pytest.importorskip("matplotlib")
pytest.importorskip("zarr")
pytestmark = pytest.mark.usefixtures("undrawn_pictures")


@pytest.mark.slow
def test_summary_and_page(tmp_path: Path) -> None:
    night = night_with(1, effect=0.2)
    written = write_night(night, tmp_path)
    assert [path.name for path in written] == ["night.json", "night.html"]

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    summary = json.loads((tmp_path / "night.json").read_text(encoding="utf-8"), parse_constant=refuse)
    found = differences(night)[0]
    of_all = summary["differences"][0]
    assert of_all["measured"]["value"] == pytest.approx(found.measured.value, rel=1e-5)
    assert of_all["paired"]["value"] == pytest.approx(0.2, abs=0.05)
    assert summary["verdicts"][0]["outcome"] == "holds"
    html = (tmp_path / "night.html").read_text(encoding="utf-8")
    sections = re.findall(r'<section id="([^"]+)"', html)
    assert sections == [
        "night-verdicts", "night-paper", "night-panels", "night-means", "night-differences", "night-r0",
        "night-settings",
    ]  # fmt: skip
    for mean in ("0.184", "0.203", "0.209", "0.196"):  # Table 1 without TV
        assert f"{mean}<" in html
    assert len(summary["paper"]) == 4


def test_what_is_not_known_is_null() -> None:
    night = without_r0(night_with(2, paired=False))
    summary = night_summary(replace(night, true_r0_m=night.r0_m))
    json.dumps(summary, allow_nan=False)
    assert summary["against_r0"] == []
    assert summary["differences"][0]["paired"] is None
    lines = night_summary_text(night_with(3)).splitlines()
    assert len(lines) == 4 + 4 + 2  # verdicts, means and differences
    assert all(" σ" in line for line in lines[:4] + lines[8:])
    assert all("alternating" in line for line in lines[8:])
