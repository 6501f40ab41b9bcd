"""Commands that are refused: the words of each, and what its error of one line names; nothing is written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, LAYOUT, SETTINGS, STUDY, Commands, simulated
from tests.cli.layout.test_command import SHAPE, frames
from tests.cli.layout.test_grid import QUAD
from tests.io import loop_layouts
from tests.io.frame_files import fits
from tests.refusals import assert_all_refused
from tests.shared_data import skip_without

from faintspot import Calibration
from faintspot.slopes.pipeline.configuration import to_text
from faintspot.slopes.recorded.measuring import measure_recorded
from faintspot.slopes.simulate import sensor_frames

TUNE = "tune --read-noise-e 3 --pixels 8 --fwhm-px 1.8"
GIVEN = f"{TUNE} --flux-e 200"
TELEMETRY = "telemetry sparta --output page.html"
REFUSED: dict[str, dict[str, tuple[str, ...]]] = {
    "faintspot": {
        "layuot": ("layuot", "'layout'"),
        "nix": ("nix", "faintspot --help"),
        "--nix": ("--nix", "faintspot --help"),
        "layout a.fits --nix": ("--nix", "faintspot layout --help"),
        "layout a.fits --geometry round": ("--geometry", "round", "hexagonal"),
        "report": ("SLOPES", "faintspot report --help"),
    },
    "slopes": {
        "slopes missing.fits": ("missing.fits",),
        "slopes *.fits": ("*.fits",),
        "slopes text.fits": ("text.fits", "FITS"),
        "slopes half.fits.gz -o half.npz": ("half.fits.gz", "frames"),
        "slopes large.npy": ("large.npy", "33 x 32", "32 x 32", "faintspot.toml"),
        "slopes frames.npz --key day": ("frames.npz", "'day'", "frames (6 x 32 x 32)"),
        "slopes a.npy -c nix.toml": ("nix.toml", "faintspot layout"),
        "slopes a.npy -c text.fits": ("text.fits", "TOML", "line 1"),
        "slopes a.npy --unit arcsec": ("unit", "pixel_scale_arcsec"),
        "slopes a.npy -o s.xyz": ("s.xyz", ".zarr", ".csv"),
        "slopes a.npy -o nix/s.npz": ("nix/s.npz", "folder nix"),
        "slopes a.npy -o a.npy/s.npz": ("a.npy/s.npz",),
        "slopes a.npy -o s.csv": ("s.csv", "--overwrite"),
        "slopes a.npy -o s.npz --no-denoise": ("s.npz", "--overwrite"),
        "slopes a.npy -o foreign.zarr --overwrite": ("foreign.zarr",),
        "slopes frames.npz -o frames.npz --overwrite": ("frames.npz", "frames"),
        "slopes frames.npz:frames -o frames.npz --overwrite": ("frames.npz", "frames"),
        "slopes a.npy --reference shape.npy": ("shape.npy", "reference", "(16, 2)", "(16, 3)"),
        "slopes a.npy --reference nan.npy": ("nan.npy", "reference"),
        "slopes a.npy --reference nix.npy": ("nix.npy",),
        "slopes a.npy --follow --mean-flux": ("--follow", "--mean-flux"),
        "slopes a.npy --follow -c plain.toml": ("plain.toml", "pitch_px"),
        "sodium a.npy": ("[laser]",),
    },
    "report": {
        "report nix.zarr": ("nix.zarr",),
        "report a.npy": ("a.npy",),
        "report .": (".: ", "Zarr store of slopes"),
        "report s.npz s.csv s.csv": ("one file or two", "3"),
        "report text.npz": ("text.npz", "slopes"),
        "report frames.npz": ("frames.npz", "slopes"),
        "report foreign.zarr": ("foreign.zarr",),
        "report s.npz --recording nix.npy": ("nix.npy",),
        "report s.npz -o nix/page.html": ("nix/page.html",),
        "report s.npz -o s.npz": ("s.npz", "page"),
    },
    "wavefront": {
        "wavefront nothing.npz": ("nothing.npz",),
        "wavefront s.csv": ("s.csv", "layout"),
        "wavefront s.npz -o w.txt": ("w.txt", ".json"),
        "wavefront s.npz --modes 30": ("modes = 30", "2 to 24"),
        "wavefront other.npz --modes 9": ("modes = 9", "2 to 8"),
        "wavefront s.npz --pixel-scale-arcsec -1": ("pixel_scale_arcsec", "-1"),
        "wavefront s.npz --drift 0": ("bins", "3"),
        "wavefront s.npz --drift 4": ("bins", "3"),
        "wavefront s.npz --minus nothing.npz": ("nothing.npz",),
        "wavefront s.npz --minus other.npz": ("other.npz", "16 sub-apertures", "--config"),
        "wavefront s.npz --stroke 1": ("--actuators",),
        "wavefront s.npz --actuators mirror.npy": ("mirror.npy", "(6, 32)"),
        "wavefront s.npz --actuators no.npy": ("no.npy",),
        "wavefront s.npz --actuators mirror.npy --command c.txt": ("c.txt", ".npy, .csv"),
    },
    "tune": {
        "tune": ("read_noise_e", "--read-noise-e"),
        "tune --read-noise-e abc": ("--read-noise-e",),
        f"{GIVEN} --read-noise-e -3": ("read_noise_e = -3",),
        TUNE: ("magnitude", "flux_e"),
        f"{GIVEN} --magnitude 3": ("--magnitude", "both"),
        f"{GIVEN} --budget 3furlongs": ("budget", "0.05arcsec"),
        f"{TUNE} --flux-e nan": ("--flux-e", "finite"),
        f"{TUNE} --flux-e -3": ("--flux-e", "above 0"),
        f"{GIVEN} --config nothere.toml": ("nothere.toml",),
        f"{GIVEN} --dark dark.fits": ("--recording",),
        f"{GIVEN} -o nofolder/faintspot.toml": ("nofolder",),
        f"{GIVEN} -o faintspot.toml": ("faintspot.toml", "--overwrite"),
        "tune --recording nothere.fits": ("nothere.fits",),
        "tune --recording quad.npy --config quad.toml": ("quad cells",),
        f"{GIVEN} --pixels 2": ("quad cells",),
    },
    "layout": {
        "layout noise.npy": ("noise.npy", "pitch"),
        "layout nan.npy": ("nan.npy", "NaN"),
        "layout even.npy": ("even.npy",),
        "layout swapped.npy": ("swapped.npy", "bytes"),
        "layout nix.fits": ("nix.fits",),
        "layout spots.npy --dark nix.fits": ("nix.fits",),
        "layout spots.npy --dark nan": ("dark", "finite"),
        "layout spots.npy --dark other.npy": ("dark", "(150, 160)", "(3, 3)"),
        "layout spots.npy --flat zero.npy": ("zero.npy", "above 0"),
        "layout spots.npy --gain-e-per-adu 0": ("gain_e_per_adu = 0",),
        "layout spots.npy --diameter-m 0": ("diameter_m = 0",),
        "layout spots.npy --pixels 12,14,16": ("--pixels",),
        "layout spots.npy --bin 2 --pixels 31": ("--pixels", "bin = 2"),
        "layout spots.npy --pitch-px 2": ("--pitch-px",),
        "layout spots.npy --exclude 3,x": ("exclude",),
        "layout spots.npy --exclude 0-48": ("exclude",),
        "layout spots.npy --pupil 1,2": ("pupil",),
        "layout spots.npy --roi 0,0,1000,10": ("roi",),
        "layout spots.npy --illuminated-fraction 2": ("--illuminated-fraction", "2"),
        "layout spots.npy --fit colour": ("--fit", "colour", "centre"),
        "layout spots.npy --picture nix/p.png": ("nix/p.png",),
    },
    "grid": {
        "layout": ("FRAME", "--accept"),
        "layout spots.npy --accept": ("--accept",),
        "layout quad.npy --grid 8": ("--grid 8",),
        "layout quad.npy --grid 8x8 --pitch-px 2": ("--pitch-px",),
        "layout quad.npy --grid 80x8": ("cells", "80 x 8"),
        "layout quad.npy --grid 8x8 --pixels 3": ("pixels", "3"),
        "layout quad.npy --grid 8x8 --roi 0,0,300,20": ("roi = 0, 0, 300, 20",),
        "layout quad.npy --grid 8x8 --pupil -90,0,3": ("cell",),
        "layout quad.npy --grid 8x8 --illuminated-fraction 2": ("--illuminated-fraction", "2"),
    },
    "demo": {
        "demo --frames 5": ("--frames", "5"),
        "demo --seed -1": ("--seed", "-1"),
        "demo -o faintspot.toml": ("faintspot.toml", "folder"),
    },
    "export": {
        "export library -o library --cpu z80": ("z80", "x86-64-v3"),
        "export library binned.toml -o library": ("bin", "1"),
        "export library none.toml": ("none.toml",),
        "export telemetry a.zarr": ("a.zarr",),
        "export telemetry a.zarr -o b": ("b", ".fits"),
    },
    "study": {
        "study nothing.toml": ("nothing.toml",),
        "study noise.toml": ("noise.toml", "read_noise_e = -1"),
        "study sizes.toml": ("sizes.toml", "sizes", "size"),
        "study paper --figure fig99": ("fig99",),
        "study paper --workers -1": ("--workers", "-1"),
        "loop magnitude nowhere.toml": ("nowhere.toml", "canary"),
        "loop show nowhere": ("nowhere",),
        "loop engine canary --frame-rate-hz 0": ("frame_rate_hz",),
        "loop magnitude canary --flux-e 1,x": ("--flux-e 1,x",),
        "loop magnitude canary --flux-e -1": ("photons",),
        "loop magnitude canary -o no/where": ("folder no",),
        "loop night canary --strengths x": ("--strengths x",),
        "loop night canary --methods x": ("methods", "two or more"),
    },
    "telemetry": {
        f"{TELEMETRY} --slopes Slopes": ("--slopes", "Gradients"),
        f"{TELEMETRY} --slopes gradients": ("--slope-unit",),
        f"{TELEMETRY} --slope-unit px": ("--cells",),
        f"{TELEMETRY} --slope-unit px --cells none --slope-order rows": ("slope_order", "rows", "pairs"),
    },
    "realtime": {
        "live --bind everywhere --port 0": ("everywhere", "IP address"),
        "live --name ../x --port 0": ("name = '../x'",),
        "realtime run --name nobody --close-loop": ("--close-loop", "[control]", "faintspot.toml"),
        "realtime run --name nobody --config control.toml": ("32 rows", "16 sub-apertures", "30"),
        "realtime record night --name nobody": ("night", ".zarr"),
        "realtime record a.zarr --name nobody": ("nobody",),
        "realtime bridge --name nobody": ("--to", "--commands"),
        "realtime bridge --to isio:b --frames 3": ("--frames",),
        "realtime bridge --to b": ("isio:NAME",),
        "realtime demo --name nobody --flux-e 0": ("photons_per_subaperture",),
        "realtime demo --name nobody -o faintspot.toml": ("faintspot.toml",),
    },
}
NEEDED = {"study": ("hcipy", "xarray", "zarr"), "realtime": ("hcipy", "pyshmem", "tornado", "zarr")}
SLOW = ("layout", "realtime")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the commands name."""
    folder = tmp_path_factory.mktemp("commands")
    arrays: dict[str, Any] = {
        "a": simulated(6),
        "large": np.ones((3, 33, 32)),
        "shape": np.ones((16, 3)),
        "nan": np.full((16, 2), np.nan),
        "two": simulated(2)[:, :16, :16],
        "mirror": np.ones((6, 32)),
        "spots": frames(),
        "noise": np.random.default_rng(3).normal(100, 5, (3, 128, 128)),
        "even": np.ones((128, 128)),
        "swapped": (frames(n_frames=1)[0].round().astype("<u2") + 200).byteswap(),
        "other": np.ones((3, 3)),
        "zero": np.zeros(SHAPE),
        "quad": sensor_frames(QUAD, 5, flux_e=500.0, rng=np.random.default_rng(1))[0],
        "matrix": np.random.default_rng(1).standard_normal((30, 10)),
    }
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    np.savez(folder / "frames.npz", frames=arrays["a"])
    fits.PrimaryHDU(simulated()).writeto(folder / "half.fits.gz")
    compressed = (folder / "half.fits.gz").read_bytes()
    (folder / "half.fits.gz").write_bytes(compressed[: len(compressed) // 2])
    for item in (QUAD, Calibration(read_noise_e=2.0)):
        item.save(folder / "quad.toml")
    for name, text in {
        "faintspot.toml": CONFIGURATION,
        "two.toml": CONFIGURATION.replace("[4, 4]", "[2, 2]"),
        "plain.toml": to_text(LAYOUT, SETTINGS).replace("pitch_px", "# pitch_px"),
        "binned.toml": f"[layout]\nbin = 2\n{CONFIGURATION}",
        "control.toml": f'{CONFIGURATION}[control]\ninteraction_matrix = "matrix.npy"\n',
        "noise.toml": f"{STUDY}read_noise_e = -1\n",
        "sizes.toml": f"{STUDY}sizes = 1\n",
        "text.fits": "x, y\n1, 2\n",
        "text.npz": "nothing",
    }.items():
        (folder / name).write_text(text)
    for name in ("s.npz", "s.csv"):
        measure_recorded([folder / "a.npy"], folder / "faintspot.toml", folder / name)
    measure_recorded([folder / "two.npy"], folder / "two.toml", folder / "other.npz")
    for name in ("foreign.zarr", "sparta"):
        (folder / name).mkdir()
    (folder / "foreign.zarr" / "precious").touch()
    loop = loop_layouts.random_loop()
    loop_layouts.sparta(folder / "sparta", loop._replace(slopes=loop.slopes[:, :12], matrix=loop.matrix[:12]))
    return folder


@pytest.mark.parametrize(
    "group", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in REFUSED]
)
def test_commands_that_are_refused(
    files: Path, group: str, run: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in NEEDED.get(group, ()):
        skip_without(package)
    monkeypatch.chdir(files)
    names = {path.name for path in files.iterdir()}
    before = {path: path.read_bytes() for path in files.rglob("*") if path.is_file()}

    def refusal(line: str) -> str:
        output = (
            ("-o", "new.toml") if group in ("layout", "grid", "tune") and "-o" not in line.split() else ()
        )
        return run.refused(*line.split(), *output).error

    assert_all_refused(REFUSED[group].items(), refusal)
    assert {path: path.read_bytes() for path in before} == before
    assert {path.name for path in files.iterdir()} <= {*names, "half.npz.partial.zarr"}
