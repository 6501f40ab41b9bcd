"""Measure slopes with libfaintspot.so from Python without faintspot: ctypes and NumPy.

faintspot export library faintspot.toml -o library
python measure.py library/libfaintspot.so library/faintspot.bundle frame.npy
"""

import ctypes
import sys

import numpy as np

PIXELS = {"uint16": 0, "float32": 1, "images": 2}
_WINDOW, _FRAME = ("window_height", "window_width"), ("frame_height", "frame_width")
_SENSOR = ("subapertures", *_WINDOW, *_FRAME, "width", "groups", "pixels")
_TEXTS = ("processor", "version", "fingerprint")
_SLOPES = {
    **dict.fromkeys(("x", "y", "flux"), np.float32),
    "flags": np.uint8,
    "iterations": np.int32,
    "bad_pixels": np.int32,
    **dict.fromkeys(("standard_error_x", "standard_error_y", "covariance_xy"), np.float32),
}


class _SensorStructure(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in _SENSOR] + [(name, ctypes.c_char_p) for name in _TEXTS]


class Sensor:
    """Sensor described by a bundle; `slopes` has the arrays of the last frame."""

    def __init__(self, library, bundle, pixels="uint16", threads=1):
        self._library, handle, integer = ctypes.CDLL(library), ctypes.c_void_p, ctypes.c_int
        self._library.faintspot_create.restype = self._library.faintspot_results.restype = handle
        self._library.faintspot_describe.restype = ctypes.POINTER(_SensorStructure)
        self._library.faintspot_parameter.restype = ctypes.c_char_p
        error = ctypes.c_char_p()
        self._handle = handle(
            self._library.faintspot_create(
                bundle, ctypes.c_size_t(len(bundle)), PIXELS[pixels], integer(threads), ctypes.byref(error)
            )
        )
        if not self._handle:
            raise ValueError(error.value.decode())
        self.sensor = self._library.faintspot_describe(self._handle).contents
        pointers = (handle * len(_SLOPES)).from_address(self._library.faintspot_results(self._handle))
        self.slopes = {
            name: np.ctypeslib.as_array(
                ctypes.cast(pointer, ctypes.POINTER(np.ctypeslib.as_ctypes_type(kind))),
                (self.sensor.subapertures,),
            )
            for (name, kind), pointer in zip(_SLOPES.items(), pointers, strict=True)
        }

    def call(self, name, *arguments):
        """Call a function of the library: arrays as pointers, None as NULL."""
        passed = [a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else a for a in arguments]
        return getattr(self._library, f"faintspot_{name}")(self._handle, *passed)

    def measure(self, frame):
        """Measure a whole frame."""
        self.call("measure", 0, frame, 0, self.sensor.groups)
        self.call("finish", 0, frame)
        return self.slopes

    def close(self):
        """Free the memory, also that of `slopes`."""
        self._library.faintspot_destroy(self._handle)


if __name__ == "__main__":
    with open(sys.argv[2], "rb") as file:
        sensor = Sensor(sys.argv[1], file.read())
    frame = np.ascontiguousarray(np.load(sys.argv[3]), np.uint16)
    slopes = sensor.measure(frame)
    valid = slopes["flags"] == 0
    print(f"{len(valid)} sub-apertures, {valid.sum()} valid, x of the first {slopes['x'][0]:.6f} px")
    sensor.close()
