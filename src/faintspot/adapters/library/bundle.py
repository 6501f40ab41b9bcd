"""Tables of one sensor and estimator in the form that faintspot.c reads: a bundle.

A bundle holds a variant for each kind of pixels and width of the processor's vectors. A variant is the list
of cells that its kernels are called with (see `objects`) and the arrays that the cells point to.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.library.objects import argument_types
from faintspot.base import __version__
from faintspot.base.errors import InputError
from faintspot.engine.frames.frame_path import check_real_time, last_rows_of_groups
from faintspot.slopes.kernels.compiling import types
from faintspot.slopes.kernels.groups import ERROR_SCALE, SlopeArrays
from faintspot.slopes.kernels.validity.doubtful import check_slopes
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

FORMAT = 1
PIXELS = ("uint16", "float32", "images")
"""Kinds of pixels: frames of uint16 or float32 [ADU], or calibrated images of float32 [e-]."""

# Whose an array is: of all, of one object, of a thread, given.
_CONSTANT, _INSTANCE, _THREAD, _FRAME = range(4)
_VALUE, _POINTER = range(2)
_NAMED = (
    *("source.corners", "task.settings", "task.prior", "start", "stop"),
    *(f"slopes.{name}" for name in SlopeArrays._fields),
)
_MEASURE = ("source", "task", "start", "stop", "scratch", "slopes", "stages")
_CHECK = ("light_test", "frames", "slopes", "expected", "scratch")
_ALIGNED = 64
_CHECKED, _HEADER = 16, 88  # where the part begins that has a checksum, and where the header ends


class Call(NamedTuple):
    """A kernel, and the arguments that it is called with, by name."""

    kernel: Any
    arguments: dict[str, Any]

    @property
    def kinds(self) -> tuple[Any, ...]:
        """Types of the arguments."""
        return argument_types(tuple(self.arguments.values()))


class Variant(NamedTuple):
    """Tables for one kind of pixels and one width."""

    pixels: str
    pipeline: SlopePipeline
    measure: Call
    check: Call

    @classmethod
    def of(cls, pipeline: SlopePipeline, pixels: str, width: int) -> Variant:
        """Prepare a pipeline for a kind of pixels and a width."""
        own = (pipeline.for_images() if pixels == "images" else pipeline).with_width(width)
        dtype = np.dtype(np.uint16 if pixels == "uint16" else np.float32)
        frames = np.zeros((1, *own.layout.frame_shape), dtype)
        arguments = own.arguments(frames, dtype)
        measuring = arguments.measuring(0, arguments.groups, own.new_scratch())
        measure = dict(zip(_MEASURE, measuring, strict=True))
        check = dict(zip(_CHECK, arguments.checking(own.new_check_scratch()), strict=True))
        return cls(pixels, own, Call(own.plan.prepared.kernel, measure), Call(check_slopes, check))


def check_exportable(pipeline: SlopePipeline) -> None:
    """Refuse what compiled code alone cannot measure.

    Raises
    ------
    InputError
        For estimators in Python, binned frames, and settings that follow the flux of each frame.
    """
    if pipeline.plan.prepared.in_python:
        name = pipeline.settings.estimator.name
        raise InputError(f"estimator {name!r}: expected a compiled one, got one in Python; choose another")
    if pipeline.layout.bin > 1:
        raise InputError(f"layout.bin = {pipeline.layout.bin}: expected 1; bin in the camera")
    check_real_time(pipeline)


def bundle_of(variants: Sequence[tuple[Variant, str, str]], fingerprint: bytes) -> bytes:
    """Return the bundle of variants, each with the fingerprints of its two kernels, the best first."""
    pool = _Pool()
    blocks = [_block(variant, measure, check, pool) for variant, measure, check in variants]
    texts = (__version__.encode(), hashlib.sha256(fingerprint).hexdigest()[:16].encode())
    entries, start = b"", _HEADER + 16 * len(blocks)
    for block in blocks:
        entries += struct.pack("<qq", start, len(block))
        start += len(block)
    content = entries + b"".join(blocks)
    pool_start = -(-(_HEADER + len(content)) // _ALIGNED) * _ALIGNED
    sizes = struct.pack("<qqq24s24s", pool_start, pool_start + len(pool.data), len(blocks), *texts)
    checked = (sizes + content).ljust(pool_start - _CHECKED, b"\0") + pool.data
    return struct.pack("<4sIII", b"FSPT", FORMAT, zlib.crc32(checked), 0) + checked


class _Pool:
    """Contents of arrays, each once."""

    def __init__(self) -> None:
        self.data, self._known = bytearray(), dict[bytes, int]()

    def place(self, content: bytes) -> int:
        """Return where a content begins."""
        digest = hashlib.sha256(content).digest()
        if digest not in self._known:
            self.data += bytes(-len(self.data) % _ALIGNED)
            self._known[digest] = len(self.data)
            self.data += content
        return self._known[digest]


class _Cells:
    """Cells of a variant's two calls, and the arrays that they point to."""

    def __init__(self, pool: _Pool) -> None:
        self.cells: list[tuple[int, int]] = []
        self.arrays: list[tuple[int, int, int]] = []  # owner, offset in the pool or -1, bytes
        self.places: dict[str, int] = {}
        self._pool, self._known = pool, dict[tuple[int, int, int], int]()

    def add(self, value: Any, kind: Any, path: str, owner: Callable[[str], int]) -> None:
        """Take an argument apart as Numba does."""
        self.places[path] = len(self.cells)
        if isinstance(kind, types.BaseTuple):
            names = kind.fields if isinstance(kind, types.BaseNamedTuple) else range(len(kind))
            for name, part, its in zip(names, value, kind.types, strict=True):
                self.add(part, its, f"{path}.{name}", owner)
        elif isinstance(kind, types.Array):
            index = self._array(value, owner(path))
            numbers = (0, 0, value.size, value.itemsize), (*value.shape, *value.strides)
            self.cells += [(_VALUE, number) for number in numbers[0]]
            self.cells.append((_POINTER, index))
            self.cells += [(_VALUE, number) for number in numbers[1]]
        elif isinstance(kind, types.Float):
            bits = struct.pack("<f4x" if kind == types.float32 else "<d", value)
            self.cells.append((_VALUE, int.from_bytes(bits, "little", signed=True)))
        else:  # lanes and None have no data
            self.cells.append((_VALUE, int(value) if isinstance(kind, types.Integer | types.Boolean) else 0))

    def _array(self, array: NDArray[Any], owner: int) -> int:
        if not array.flags.c_contiguous:
            raise TypeError("expected contiguous arrays")
        key = array.__array_interface__["data"][0] if array.nbytes else 0, array.nbytes, owner
        if key not in self._known:
            stored = owner in (_CONSTANT, _INSTANCE) and array.nbytes > 0
            offset = self._pool.place(array.tobytes()) if stored else -1
            self._known[key] = len(self.arrays)
            self.arrays.append((owner, offset, array.nbytes))
        return self._known[key]


def _owner(path: str) -> int:
    """Return whose an array is."""
    if path.startswith(("source.frames", "check.frames")):
        return _FRAME
    if path.startswith(("scratch", "check.scratch")):
        return _THREAD
    instance = path.startswith(("slopes", "check.slopes", "task.settings", "task.prior"))
    return _INSTANCE if instance else _CONSTANT


def _block(variant: Variant, measure: str, check: str, pool: _Pool) -> bytes:
    """Return a variant's lists."""
    pipeline, cells = variant.pipeline, _Cells(pool)
    for (path, value), kind in zip(variant.measure.arguments.items(), variant.measure.kinds, strict=True):
        cells.add(value, kind, path, _owner)
    count = len(cells.cells)
    for (path, value), kind in zip(variant.check.arguments.items(), variant.check.kinds, strict=True):
        cells.add(value, kind, f"check.{path}", _owner)
    used = "frames.counts" if variant.pixels == "uint16" else "frames.values"
    named = [cells.places[name] for name in (f"source.{used}", *_NAMED, f"check.{used}")]
    rows = last_rows_of_groups(pipeline, pipeline.width)
    parameters = _parameters(pipeline)
    prepared, layout = pipeline.plan.prepared, pipeline.layout
    prior_row = -1 if prepared.prior_weight_row is None else prepared.prior_weight_row
    head = struct.pack(
        "<QQ18i",
        *(int(kernel, 16) for kernel in (measure, check)),
        *(PIXELS.index(variant.pixels), pipeline.width, len(layout), *layout.window, *layout.frame_shape),
        *(len(rows), pipeline.plan.settings.shape[1], prior_row, ERROR_SCALE),
        *(max(layout.frame_shape), len(parameters), count, len(cells.cells) - count),
        *(len(cells.arrays), len(named), 0),
    )
    lists = [struct.pack("<qq", *cell) for cell in cells.cells]
    lists += [struct.pack("<qqq", *array) for array in cells.arrays]
    numbers = np.array([*named, *rows], np.int32).tobytes()
    text = head + b"".join(lists) + b"".join(parameters) + numbers
    return text + bytes(-len(text) % 8)


def _parameters(pipeline: SlopePipeline) -> list[bytes]:
    """Return the options that may change between frames: name, row, whether they are whole, bounds."""
    rows = pipeline.plan.prepared.rows_of_options.items()
    found = []
    for name, row in rows:
        option = pipeline.settings.declared()[name]
        low = np.nextafter(np.float32(option.low), np.float32(np.inf)) if option.low_open else option.low
        found.append(struct.pack("<24siiff", name.encode(), row, option.whole, low, option.high))
    return found
