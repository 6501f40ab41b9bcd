"""Damaged files of every format: a result, or an InputError in one line."""

import re
import shutil
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tests.io import loop_layouts
from tests.refusals import refused_in_one_line

import faintspot as fs
from faintspot.experiments.study.specification import StudySpecification
from faintspot.io import open_frames, read_array, read_slopes
from faintspot.io.frames import frame_format
from faintspot.io.slopes import read_reference
from faintspot.loop.simulation.configuration import LoopConfiguration, load_loop
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.spots.psf import PSF

_NUMBER = re.compile(rb"\d+(\.\d*)?([eE][-+]?\d+)?")
_WORDS = (b"1e300", b"-1", b"nan", b"-inf", b"0", b"0.5", b"9" * 30, b'"x"', b"[]", b"{}", b"true", b"null")
_STUDY = """name = "s"
seed = 3
realisations = 40
methods = ["tv", "brightest"]
fixed_k = [5]
[sweeps.light]
flux_e = { from = 10, to = 100, points = 3, spacing = "log" }
pixels = 8
"""


def run(seed: int) -> None:
    """Damage one file, and read it."""
    rng = np.random.default_rng(seed)
    name = list(READERS)[seed % len(READERS)]
    originals = _originals()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / name
        kin = originals.glob("faintspot.*") if name.startswith("faintspot.") else [originals / name]
        for original in kin:
            copy = shutil.copytree if original.is_dir() else shutil.copyfile
            copy(original, path.with_name(original.name))
        _damage(rng, path)
        refused_in_one_line(lambda: READERS[name](path))


# Sound files ------------------------------------------------------------------------------------------


def _read_frames(path: Path) -> None:
    with open_frames([path]) as frames:
        frames.block(0, 1)
        frames.block(frames.n_frames - 1, frames.n_frames)
    read_array(path)


def _read_slopes(path: Path) -> None:
    slopes = read_slopes(path)
    assert len({array.shape for array in slopes.variables.values()}) == 1
    assert all(array.shape == slopes.variables["x"].shape[1:] for array in slopes.coordinates.values())


def _read_configuration(path: Path) -> None:
    configuration.has(path, "settings")
    fs.SlopePipeline.from_file(path)


def _read_telemetry(path: Path) -> None:
    from faintspot.io import read_telemetry, write_aot

    telemetry = read_telemetry(path)
    write_aot(path.with_name("aot.fits"), telemetry)


def _read_aot(path: Path) -> None:
    from faintspot.io import read_aot

    read_aot(path)
    _read_frames(path)


def _read_arrays(path: Path) -> None:
    """Read all arrays of a file whose format lists them, or the only one."""
    for name in frame_format(path).names(path) or [""]:
        read_array(f"{path}:{name}" if name else path)


def _read_loop(path: Path) -> None:
    from faintspot.loop.telemetry.recorded_loop import read_recorded_loop

    stated: dict[str, Any] = {"slope_unit": "px", "frame_rate_hz": 250.0}
    if path.name == "milk":
        stated |= {"slopes": "wfs", "commands": "dm"}
    read_recorded_loop(path, stated=stated)


_IMAGES = ("png", "bmp", "jpg", "lzw.tif")


def _frame_readers() -> dict[str, Callable[[Path], Any]]:
    from tests.io import frame_files

    # SciPy ends the process on some damaged MATLAB files.
    endings = [ending for ending, kind in frame_files.FRAME_FILES.items() if not kind.whole]
    return {f"frames.{ending}": _read_frames for ending in (*endings, *_IMAGES)}


READERS: dict[str, Callable[[Path], Any]] = {
    **_frame_readers(),
    **{f"slopes.{form}": _read_slopes for form in ("zarr", "npz", "fits", "fits.gz", "csv")},
    "reference.npz": read_reference,
    "telemetry.zarr": _read_telemetry,
    "aot.fits": _read_aot,
    "trs.sav": _read_arrays,
    "packed.sav": _read_arrays,
    "table.fits": _read_arrays,
    "poke.txt": _read_arrays,
    **dict.fromkeys((*loop_layouts.WRITERS, "keck"), _read_loop),
    "psf.npz": PSF.load,
    "weights.npz": fs.FixedWeights.load,
    "faintspot.toml": _read_configuration,
    "faintspot.calibration.npz": lambda path: _read_configuration(path.with_name("faintspot.toml")),
    "study.toml": StudySpecification.from_file,
    "loop.toml": load_loop,
}


@cache
def _originals() -> Path:
    """Return a folder with a sound file of each, which stays as long as the process."""
    from tests.io import frame_files, idl_file, slope_files, telemetry_files
    from tests.io.formats.test_fits_files import table

    from faintspot.engine.telemetry.recorder import TelemetryStore
    from faintspot.io import read_telemetry, write_aot

    keep = tempfile.TemporaryDirectory()
    _kept.append(keep)
    folder = Path(keep.name)
    for name in READERS:
        if name.removeprefix("frames.") in _IMAGES:
            options = {"compression": "tiff_lzw"} if name.endswith("tif") else {}
            dtype = "uint8" if name.endswith(("bmp", "jpg")) else "uint16"
            Image.fromarray(frame_files.cube(1, 60, 80, dtype)[0]).save(folder / name, **options)
        elif name.startswith("frames."):
            frame_files.save(folder / name, frame_files.cube(5))
        elif name.startswith("slopes."):
            slope_files.write(folder / name, slope_files.result(20))
    slope_files.write(folder / "reference.npz", slope_files.result(20))
    store = TelemetryStore(
        folder / "telemetry.zarr", telemetry_files.RECORD, telemetry_files.IMAGE, telemetry_files.ATTRIBUTES
    )
    some = telemetry_files.records_of(10, 5), telemetry_files.images_of(10)
    store.append(*some, {"changes": telemetry_files.CHANGES})
    write_aot(folder / "aot.fits", read_telemetry(store.path))
    saved = {"rx": np.eye(5), "A": {"DMCOMMAND": np.ones((30, 4), np.float32), "COUNTS": np.arange(9)}}
    for name in ("trs.sav", "packed.sav"):
        idl_file.write(folder / name, saved, compressed=name == "packed.sav")
    table(folder / "table.fits")
    loop = loop_layouts.random_loop()
    for name, write in {**loop_layouts.WRITERS, "keck": loop_layouts.keck}.items():
        (folder / name).mkdir()
        write(folder / name, loop)
    np.savetxt(folder / "poke.txt", np.eye(9), header="poke")
    psf = PSF.analytic(radius_px=5)
    weights = fs.FixedWeights(*np.random.default_rng(0).uniform(0.1, 1.0, (3, 8, 8)))
    psf.save(folder / "psf.npz")
    weights.save(folder / "weights.npz")
    path = folder / "faintspot.toml"
    layout = fs.Layout.grid((3, 3), pixels=8)
    camera = fs.Calibration(
        np.full((24, 24), 20.0), bad_pixels=np.eye(24, dtype=bool), read_noise_e=1.0, background_e=2.0
    )
    chosen = fs.Settings("map", flux_e=100.0, search_range_px=2.0, prior_std_px=1.0).replace(
        where=3, flux_e=50.0
    )
    for item in (layout, camera, chosen, psf, weights):
        configuration.save(path, item)
    (folder / "study.toml").write_text(_STUDY)
    (folder / "loop.toml").write_text(LoopConfiguration().to_text())
    return folder


_kept: list[Any] = []

# Damage -----------------------------------------------------------------------------------------------


def _damage(rng: np.random.Generator, path: Path) -> None:
    """Damage a file, or one of a store's; of arrays in a .npz file also what they hold."""
    if path.is_dir():
        inside = sorted(file for file in path.rglob("*") if file.is_file())
        described = [file for file in inside if file.suffix == ".json" or file.name.startswith(".z")]
        chosen = described if described and rng.random() < 0.6 else inside
        file = chosen[rng.integers(len(chosen))]
        if rng.random() < 0.1:
            file.unlink()
        else:
            file.write_bytes(_damaged(rng, file.read_bytes()))
        return
    if path.suffix == ".npz" and rng.random() < 0.5:
        with np.load(path) as archive:
            arrays = dict(archive)
        name = str(rng.choice(list(arrays)))
        arrays[name] = _other_array(rng, arrays[name])
        np.savez_compressed(path, **arrays)
        return
    path.write_bytes(_damaged(rng, path.read_bytes()))


def _damaged(rng: np.random.Generator, content: bytes) -> bytes:
    """Return other bytes: bits flipped, numbers or parts changed, cut off, or doubled."""
    for _ in range(1 + int(rng.geometric(0.6))):
        if not content:
            return content
        first, last = sorted(int(n) for n in rng.integers(0, len(content) + 1, 2))
        kind = rng.integers(8)
        if kind == 0:
            some = bytearray(content)
            for position in rng.integers(0, len(some), 1 + int(rng.integers(4))):
                some[position] ^= 1 << int(rng.integers(8))
            content = bytes(some)
        elif kind == 1:
            content = content[:first]
        elif kind == 2:
            content = content[:first] + content[min(last, first + 16) :]
        elif kind == 3:
            content = content[:first] + content[first : first + 64] + content[first:]
        elif kind == 4:
            content = content[:first] + rng.bytes(int(rng.integers(1, 9))) + content[first:]
        elif kind == 5 and content.isascii():
            content = content[:first] + b"[" * 5000 + content[first:]
        else:
            content = _other_number(rng, content, same_length=bool(kind == 6))
    return content


def _other_number(rng: np.random.Generator, content: bytes, same_length: bool) -> bytes:
    """Replace one number of a text, or of the text within the first kilobytes of a file."""
    numbers = list(_NUMBER.finditer(content[:20_000]))
    if not numbers:
        return content
    number = numbers[rng.integers(len(numbers))]
    size = number.end() - number.start()
    if same_length:
        new = bytes([int(rng.choice(list(b"0123456789")))]) * size
    else:
        new = _WORDS[rng.integers(len(_WORDS))]
    return content[: number.start()] + new + content[number.end() :]


def _other_array(rng: np.random.Generator, array: Any) -> Any:
    """Return an array of another type, shape or other values."""
    others: list[Callable[[], Any]] = [
        lambda: np.array("text"),
        lambda: array.astype(complex) if array.dtype.kind in "biuf" else array,
        lambda: np.full(array.shape, np.nan),
        lambda: np.full(array.shape, rng.choice([1e300, -1e300, 1e38, 0.0, -1.0, 2.0**62])),
        lambda: array[None],
        lambda: array.reshape(-1),
        lambda: array.reshape(-1)[:1],
        lambda: np.empty((0, *array.shape), array.dtype),
        lambda: np.repeat(array[None], 2, 0),
        lambda: np.zeros((1, 1, 1, 2, 1, 1)),
        lambda: np.zeros((1 << 14, 1 << 15), np.uint8),
        lambda: np.array(b"\xff\x00"),
    ]
    return others[rng.integers(len(others))]()
