"""faintspot slopes: every format in and out, equal to the pipeline, exact options, clean output."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, LAYOUT, SETTINGS, Commands, assert_equal, expected, simulated
from tests.refusals import refused

from faintspot import Calibration, SlopePipeline
from faintspot.io import read_slopes

fits = pytest.importorskip("astropy.io.fits")
zarr = pytest.importorskip("zarr")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["s.zarr", "s.fits", "s.fits.gz", "s.npz", "s.csv", "with space.npz"])
def test_slopes_are_written_in_every_format(folder: Path, run: Commands, name: str) -> None:
    frames = simulated()
    fits.PrimaryHDU(frames).writeto(folder / "a.fits.gz")
    result = run.ok("slopes", "a.fits.gz", "-o", name)
    assert_equal(folder / name, expected(frames))
    assert "30/30" in result.error
    assert "frames/s" in result.error
    assert not any(character in result.out + result.err for character in "\r\x1b")
    first, *_, last = result.out.splitlines()
    assert first == f"{name}: 30 frames, 16 sub-apertures"
    quoted = f"'{name}'" if " " in name else name
    assert last == f"Next: faintspot report {quoted}" or (name == "s.csv" and "Next" not in result.out)
    assert sorted(path.name for path in folder.iterdir()) == sorted(["a.fits.gz", "faintspot.toml", name])


@pytest.mark.slow
def test_key_chooses_an_array_of_a_file(folder: Path, run: Commands) -> None:
    frames = simulated()
    np.savez("a.npz", night=frames, dark=frames[:3])
    run.ok("slopes", "a.npz", "--key", "night", "-o", "s.npz")
    run.ok("slopes", "a.npz:night", "-o", "t.npz")
    for name in ("s.npz", "t.npz"):
        assert_equal(folder / name, expected(frames))


@pytest.mark.slow
def test_preset_goes_before_the_configuration(folder: Path, run: Commands) -> None:
    frames = simulated()
    np.save("a.npy", frames)
    SETTINGS.replace(preset="fast").save("faintspot.toml")
    assert 'preset = "fast"' in Path("faintspot.toml").read_text()
    run.ok("slopes", "a.npy", "-o", "s.npz")
    assert_equal(folder / "s.npz", SlopePipeline(LAYOUT, SETTINGS.replace(preset="fast"))(frames))
    run.ok("slopes", "a.npy", "-o", "t.npz", "--set", "preset=accurate")
    assert_equal(folder / "t.npz", expected(frames))


@pytest.mark.slow
def test_reference_is_subtracted_and_stored(folder: Path, run: Commands) -> None:
    frames = simulated()
    reference = np.random.default_rng(4).normal(0, 0.3, (16, 2))
    np.save("a.npy", frames)
    np.savez("r.npz", positions=reference, other=reference[:3])
    run.ok("slopes", "a.npy", "-o", "s.npz", "--reference", "r.npz:positions")
    assert_equal(folder / "s.npz", expected(frames, reference=reference))
    np.testing.assert_array_equal(read_slopes(folder / "s.npz").attributes["reference"], reference)


@pytest.mark.slow
def test_again_is_complete_already_and_overwrite_makes_it_anew(folder: Path, run: Commands) -> None:
    np.save("a.npy", simulated())
    run.ok("slopes", "a.npy")
    again = run.ok("slopes", "a.npy")
    assert "complete already (30 frames)" in again.out
    assert again.err == ""
    np.save("a.npy", simulated(seed=2))  # other frames under the old name are another run
    run.refused("slopes", "a.npy", naming=("slopes.zarr", "--overwrite"))
    run.ok("slopes", "a.npy", "--overwrite")
    assert_equal(folder / "slopes.zarr", expected(simulated(seed=2)))


@pytest.mark.slow
def test_bad_frames_are_flagged_and_counted(folder: Path, run: Commands) -> None:
    frames = simulated().astype(np.float32)
    frames[3] = np.nan
    frames[9, 4, 5] = np.inf
    frames[14] = 0
    frames[20] = 65535
    np.save("a.npy", frames)
    (folder / "faintspot.toml").write_text(f"{CONFIGURATION}[calibration]\nsaturation_adu = 60000\n")
    result = run.ok("slopes", "a.npy", "-o", "s.npz", "--block", 5)
    pipeline = SlopePipeline(LAYOUT, SETTINGS, Calibration(saturation_adu=60000.0))
    assert_equal(folder / "s.npz", pipeline(frames))
    for line in (
        "  16 slopes with too many bad pixels (3.33 %)",
        "  17 slopes with saturated pixels (3.54 %)",  # an infinite pixel is above any level
        "  3 frames without any valid slope",
    ):
        assert line in result.out.splitlines(), result.out


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_memory_is_bounded(folder: Path) -> None:
    """A sparse cube of 0.8 GB within 600 MB, once the kernels are compiled: the second run counts.

    The high-water mark is that of /proc; what getrusage gives is not below that of the process that forked.
    """
    text = (folder / "faintspot.toml").read_text()
    (folder / "faintspot.toml").write_text(text.replace("pixels = 8", "pixels = 8\nframe_shape=[2048,2048]"))
    code = (
        "import sys; from faintspot.cli import main; main(sys.argv[1:]);"
        "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    )
    for n_frames in (1, 96):
        with (folder / "large.npy").open("wb") as stream:
            header = {"descr": "<u2", "fortran_order": False, "shape": (n_frames, 2048, 2048)}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.truncate(stream.tell() + 2 * n_frames * 2048 * 2048)
        command = [sys.executable, "-c", code, "slopes", "large.npy", "-o", f"{n_frames}.npz"]
        answer = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert f"{n_frames} frame" in answer
    largest_kb = int(answer.split("VmHWM:")[1].split()[0])
    assert 1024 * largest_kb < 600_000_000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.zarr", "a.fits", "a.npz", "a.csv"])
def test_slopes_in_arcsec(folder: Path, run: Commands, name: str) -> None:
    scaled = "[layout]\npixel_scale_arcsec = 0.25\n[layout.grid]"
    (folder / "faintspot.toml").write_text(CONFIGURATION.replace("[layout.grid]", scaled))
    frames = simulated(3)
    np.save("frames.npy", frames)
    run.ok("slopes", "frames.npy", "-o", name, "--unit", "arcsec")
    in_px = expected(frames)
    found = read_slopes(name, unit="arcsec")
    np.testing.assert_allclose(found.variables["x"], 0.25 * in_px.x, rtol=1e-6)
    np.testing.assert_array_equal(found.variables["flux"], in_px.flux)
    assert found.attributes["unit"] == "arcsec"
    if name.endswith(".csv"):  # without attributes
        with refused("pixel_scale_arcsec"):
            read_slopes(name)
        return
    np.testing.assert_allclose(read_slopes(name).variables["y"], in_px.y, rtol=1e-6, atol=1e-7)
    run.refused("slopes", "frames.npy", "-o", name, naming=(name, "--overwrite"))


@pytest.mark.slow
def test_without_zarr_it_cannot_resume(folder: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save("a.npy", simulated())
    monkeypatch.setitem(sys.modules, "zarr", None)
    result = run.ok("slopes", "a.npy", "-o", "s.npz")
    assert result.err.splitlines()[0].startswith("s.npz: without zarr an interrupted run starts again")
    assert_equal(folder / "s.npz", expected(simulated()))
    run.refused("slopes", "a.npy", naming=("zarr", "faintspot[io]", "-o slopes.npz"))
