"""Files that readers refuse: what is read, what the file holds, and what the error names."""

import gzip
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image
from tests.io import idl_file
from tests.io.frame_files import cube, fits, h5py, save, tifffile, zarr
from tests.io.slope_files import result, write
from tests.refusals import assert_all_refused, refusal

import faintspot as fs
from faintspot.base.text_files import parse_file
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.io import open_frames, read_array, read_slopes, read_telemetry
from faintspot.io.slopes import read_reference
from faintspot.loop.simulation.configuration import load_loop

Write = Callable[[Path], object]


class Row(NamedTuple):
    """A file, perhaps with a name within it, its content, and what the error names besides the file.

    The content is bytes, a text, an array, arrays by name, a function that writes, or None for no file.
    """

    location: str
    content: Any
    names: tuple[str, ...] = ()


def put(path: Path, content: Any) -> None:
    """Write the content of a row."""
    if isinstance(content, str | bytes):
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    elif callable(content):
        content(path)
    elif content is not None:
        save(path, content)


# Contents ---------------------------------------------------------------------------------------------


def cut(content: Any, length: int) -> Write:
    """Return what writes a file as far as this number of bytes, counted from the end where it is negative."""

    def cut_short(path: Path) -> None:
        put(path, content)
        path.write_bytes(path.read_bytes()[:length])

    return cut_short


def changed(content: Any, old: bytes, new: bytes) -> Write:
    def change(path: Path) -> None:
        put(path, content)
        assert old in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(old, new))

    return change


def header_alone(path: Path) -> None:
    """Two negative sides make a size that a file can have."""
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": True, "shape": (-3, -4)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(48))


def units(*later: Any) -> Write:
    return lambda path: fits.HDUList([fits.PrimaryHDU(), *later]).writeto(path)


def pages(path: Path) -> None:
    """Pages of two sizes."""
    with tifffile.TiffWriter(path) as writer:
        writer.write(cube(), photometric="minisblack")
        writer.write(cube(1, 3, 4)[0])


def circle(path: Path) -> None:
    """The last page states that the first is next."""
    tifffile.imwrite(path, cube(1)[0])
    for frame in cube(2):
        tifffile.imwrite(path, frame, append=True)
    with tifffile.TiffFile(path) as file:
        first, last = file.pages[0].offset, file.pages[2].offset
        link = last + 2 + 12 * len(file.pages[2].tags)
    content = bytearray(path.read_bytes())
    content[link : link + 4] = first.to_bytes(4, "little")
    path.write_bytes(content)


def elsewhere(path: Path) -> None:
    """Numbers that lie in other files."""
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout((2, 4, 4), "u1")
        layout[0] = h5py.VirtualSource("/dev/zero", "x", (4, 4))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("external", (2, 4, 4), "u1", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        file["link"] = h5py.ExternalLink("other.h5", "frames")


def hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["one"], file["two"], file["group/flat"] = cube(), cube(), np.ones(3)


def group(path: Path) -> None:
    for name in ("one", "two"):
        zarr.open_group(str(path)).create_array(name, data=cube())


def slopes(**changes: Any) -> Write:
    """Return what writes slopes."""
    return lambda path: write(path, {**result(), **changes})


def image(mode: str) -> Write:
    return lambda path: Image.fromarray(PIXELS).convert(mode).save(path)


def to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


PIXELS = np.random.default_rng(1).integers(0, 256, (60, 80, 3)).astype(np.uint8)
TABLE = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))], name="TAB")
FRAMES, IMAGE = fits.ImageHDU(cube(), name="SCI"), fits.ImageHDU(cube()[0])
COLOURS = {"dark": cube()[0], "images": np.zeros((5, 6, 8, 3)), "flat": cube()[0]}
FIVE_CHANNELS = partial(tifffile.imwrite, data=np.zeros((6, 8, 5), np.uint8), planarconfig=1)
SAVE_FILE = partial(idl_file.write, variables={"rx": np.ones((3, 4)), "A": {"B": np.ones((4, 6))}})
SAVED = {"one": cube(), "two": cube(), "flat": np.ones(3)}
NO_FRAMES: list[tuple[Any, tuple[str, ...]]] = [
    (np.zeros((2, 3, 4), complex), ("complex128",)),
    (np.zeros((2, 3, 4), "U3"), ("<U3",)),
    (np.zeros((2, 3, 4), bool), ("dtype bool",)),
    (np.zeros((2, 2, 3, 5)), ("(2, 2, 3, 5)",)),
    (np.zeros(5), ("(5,)",)),
    (np.zeros((0, 3, 4)), ("(0, 3, 4)",)),
    (np.array([[None]]), ("Python objects",)),
    (np.array(3.0), ("single number",)),
]
NO_REGULAR_FILE = [
    Row(f"{make.__name__}.{ending}", make, ("regular file",))
    for ending in ("npz", "fits", "csv")
    for make in (os.mkfifo, to_zero)
]

# What each reader refuses -----------------------------------------------------------------------------

READERS: dict[Callable[[str], Any], list[Row]] = {}


def frames(location: str) -> None:
    with open_frames([location]) as source:
        source.block(0, 1)


READERS[frames] = [
    *NO_REGULAR_FILE,
    *(Row("a.npy", *row) for row in NO_FRAMES),
    *(Row("a.npz", {"frames": array}, names) for array, names in NO_FRAMES),
    Row("missing.fits", None),
    Row("missing.npz:frames", None),
    Row("empty.fits", b""),
    Row("text.log", "some text", ("MATLAB",)),
    Row("folder", Path.mkdir, ("Zarr",)),
    Row("short.npy", b"\x93NUMPY"),
    Row("cut.npy", cut(cube(), -10)),
    Row("unnamed.npy:frames", cube(), ("frames",)),
    Row("negative.npy", header_alone, ("(-3, -4)",)),
    Row("columns.npz", np.asfortranarray(cube()), ("arr_0", "Fortran")),
    Row("several.npz", SAVED, ("one", "two", "several.npz:NAME")),
    Row("several.npz:three", SAVED, ("'three'",)),
    Row("several.zarr", group, ("one", "two", "several.zarr:NAME")),
    Row("several.zarr:three", group, ("'three'",)),
    Row("several.h5", hdf5, ("one", "two", "several.h5:NAME")),
    Row("several.h5:three", hdf5, ("'three'",)),
    Row("several.h5:group", hdf5, ("'group'",)),
    Row("colours.npz", COLOURS, ("dark (6 x 8)", "images (5 x 6 x 8 x 3)", "colours.npz:NAME")),
    Row("colours.npz:dark:green", COLOURS, ("dark:green",)),
    Row("other.fits:SCI", cube(), ("'SCI'", "PRIMARY")),
    Row("several.fits", units(FRAMES, IMAGE), ("SCI (11 x 6 x 8)", "2 (6 x 8)", "several.fits:NAME")),
    Row("table.fits", units(TABLE), ("image",)),
    Row("table.fits:TAB", units(TABLE), ("image",)),
    Row("none.fits", b"SIMPLE  but no header" * 300, ("FITS",)),
    Row("none.fits.gz", gzip.compress(b"no header" * 300), ("FITS",)),
    Row("sizes.tif", pages, ("0: 11 x 6 x 8 int16", "1: 3 x 4 int16", "sizes.tif:NUMBER")),
    Row("sizes.tif:2", pages, ("'2'", "0: 11 x 6 x 8")),
    Row("sizes.tif:frames", pages, ("'frames'", "0: 11 x 6 x 8")),
    Row("channels.tif", FIVE_CHANNELS, ("(6, 8, 5)",)),
    Row("circle.tif", circle, ("circular",)),
    Row("palette.png", image("P"), ("mode P",)),
    Row("grey.png:frames", image("L"), ("frames",)),
    Row("cut.png", cut(image("L"), 200)),
    Row("other.h5:virtual", elsewhere, ("other files",)),
    Row("other.h5:external", elsewhere, ("other files",)),
    Row("other.h5:link", elsewhere, ("'link'",)),
    Row("axes.npy", np.zeros((2, 5, 6, 8)), ("(2, 5, 6, 8)",)),
    Row("axes.npy", np.zeros((60, 60, 40)), ("(60, 60, 40)", "--time-axis 0 or 2")),
    Row("axes.npy", np.zeros((60, 40, 60)), ("(60, 40, 60)", "--time-axis 0 or 1")),
]

READERS[read_array] = [
    *NO_REGULAR_FILE,
    Row("complex.npy", np.zeros((2, 2), complex), ("complex128",)),
    Row("none.npy", np.zeros((0, 3)), ("(0, 3)",)),
    Row("number.npy", np.array(1.0), ("single number",)),
    *(
        Row("a.txt", content)
        for content in (b"", b"\n# nothing\n", b"a,b\n", b"1 2\n3\n", b"1,x\n2,3\n", b"\xff\xfe1,2\n")
    ),
    Row("a.txt:matrix", b"1 2\n", ("matrix",)),
    Row("trs.sav", SAVE_FILE, ("A.B", "trs.sav:NAME")),
    Row("trs.sav:A.NONE", SAVE_FILE, ("'A.NONE'",)),
    *(Row("trs.sav:RX", cut(SAVE_FILE, kept)) for kept in (2, 4, 30, 100, -17, -5)),
    Row("circle.sav:RX", b"SR\0\4\0\0\0\x13\0\0\0\4" + bytes(8), ("byte 4",)),  # a record that is its next
]

READERS[read_slopes] = [
    *NO_REGULAR_FILE,
    Row("missing.npz", None),
    Row("text.npz", "text"),
    Row("frames.npz", {"frames": cube()}, ("slopes",)),
    Row("folder.zarr", Path.mkdir, ("slopes",)),
]

READERS[read_reference] = [
    *NO_REGULAR_FILE,
    *(Row(name, None) for name in ("a" * 5000, "a\0b", "a\0b:frames")),
    Row("invalid.npz", slopes(valid=np.zeros((50, 7), bool)), ("valid",)),
    Row("damaged.npz", changed(slopes(), b"PK\x01\x02", b"PK\x01\x03")),  # the list of what is in it
]

READERS[fs.PSF.load] = [
    *NO_REGULAR_FILE[:2],
    Row("absent.npz", None),
    Row("text.npz", "no"),
    Row("other.npz", {"a": 1}),
    Row("dark.npz", {"samples": np.zeros((7, 7)), "oversampling": 2}),
]

READERS[read_telemetry] = [
    Row("absent.zarr", None),
    Row("empty.zarr", Path.mkdir, ("telemetry",)),
    Row("other.zarr", lambda path: zarr.create_group(str(path), zarr_format=3), ("telemetry",)),
    Row("text.zarr", "?", ("telemetry",)),
]

READERS[MagnitudeResult.load] = [Row("absent.npz", None), Row("text.npz", "nothing", ("magnitude",))]

# Configurations: the text, and what the error names ---------------------------------------------------

LAYOUT = "[layout.grid]\nshape = [2, 3]\npixels = 4\n"
TV = '[estimator]\nname = "tv"\n'

READERS[parse_file] = [
    Row("absent.toml", None),
    Row("folder.toml", Path.mkdir),
    Row("a.toml", b"\xff\xfe", ("UTF-8",)),
    Row("a.toml", "a = 1\nb = [1,,2]", ("line 2", "column 8")),
    Row("a.toml", "a = 2020-13-45"),
    Row("a.toml", "a = " + "[" * 5000),
    Row("a.toml", "a = " + "9" * 5000),
    Row("a.toml", "corners = [" + "[1, 2]," * 10**6 + "]", ("7,000,012", "4,194,304")),
]

TEXTS: dict[Callable[[str], Any], list[tuple[str, *tuple[str, ...]]]] = {
    fs.Settings.load: [
        ("[setings]", "setings", "settings"),
        ("[colours]", "colours", "layout, calibration, estimator, settings"),
        (LAYOUT, "[estimator]", "layout"),
        ("[settings]\nflux_e = 1", "[estimator]", "settings"),
        ("settings = 3", "settings", "3"),
        ("estimator = 'ml'", "estimator", "'ml'"),
        ("[estimator]\nnoise_std = 1", "estimator.name", "brightest, tv"),
        ("[estimator]\nname = 'newton'", "estimator = 'newton'", "'brightest', 'tv'"),
        (f"{TV}noise_sdt = 1", "estimator.noise_sdt", "'tv'", "noise_std"),
        (f"{TV}threshold_e = 1", "estimator.threshold_e", "'thresholded'", "'tv'"),
        (f"{TV}noise_std = 1\nflux_e = 9", "estimator.flux_e", "[settings]"),
        (f"{TV}[settings]\nnoise_std = 1", "settings.noise_std", "search_range_px"),
        (f"{TV}noise_std = -1", "estimator.noise_std = -1", "0"),
        (f"{TV}noise_std = {{ default = 1.0, first = 2.0 }}", "estimator.noise_std.first"),
        (f"{TV}noise_std = [1, 2]\n[settings]\nflux_e = [1, 2, 3]", "settings", "noise_std 2", "flux_e 3"),
        ("[settings\nnoise_std = 1", "TOML"),
    ],
    fs.Layout.load: [
        ("[layout]\nwindow = 4", "layout.frame_shape"),
        ("[layout]\nframe_shape=9\nwindow=1\ncorners=[[0,0]]", "layout.window = 1", "2 to 64"),
        ("[layout]\ncorner = [[0, 0]]", "layout.corner", "corners"),
        (f"[layout]\nwindow = 4\n{LAYOUT}", "layout.window", "grid"),
        ("[layout]\ngrid = 3", "layout.grid", "3"),
        ("[layout.grid]\nshape = [2, 3]", "layout.grid.pixels"),
        (f"{LAYOUT}outer_radus = 1", "layout.grid.outer_radus", "outer_radius"),
        (f"{LAYOUT}outer_radius = 0.1", "layout.grid.outer_radius = 0.1"),
    ],
    fs.Calibration.load: [
        ("[calibration]\nem_gain = 0", "calibration.em_gain = 0", "1e-09"),
        ("[calibration]\ndrak = 1.0", "calibration.drak", "dark"),
        ('[calibration]\ndark = "absent.npy"', "absent.npy"),
        ('[calibration]\ngain_e_per_adu = "high"', "calibration.gain_e_per_adu"),
        ("[calibration]\nbad_pixels = [1, 2]", "calibration.bad_pixels"),
        ("[calibration]\nflat = 1.0", "calibration.flat"),
        ("[calibration]\nsaturation_adu = [1.0]", "calibration.saturation_adu"),
    ],
    load_loop: [
        ("[telescop]", "telescop", "telescope"),
        ("[sensor]\npixel = 3", "sensor.pixel", "pixels"),
        ("sensor = 3", "sensor"),
        ("[sensor", "TOML"),
        ('name = ""', "name"),
    ],
}
for read, texts in TEXTS.items():
    READERS[read] = [
        Row("absent.toml", None),
        Row("binary.toml", b"\xff\xfe\0[settings]", ("TOML",)),
        *(Row("faintspot.toml", text, tuple(names)) for text, *names in texts),
    ]


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__qualname__)
def test_files_that_are_refused(tmp_path: Path, read: Callable[[str], Any]) -> None:
    def refused(given: tuple[int, Row]) -> str:
        folder, row = tmp_path / f"{given[0]}", given[1]
        folder.mkdir()
        if row.content is not None:
            put(folder / row.location.partition(":")[0], row.content)
        return refusal(lambda: read(f"{folder / row.location}"))

    rows = enumerate(READERS[read])
    assert_all_refused(
        ((given, (given[1].location.partition(":")[0], *given[1].names)) for given in rows), refused
    )
