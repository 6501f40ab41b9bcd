"""Arrays that touch a page which nobody may read or write: one element too far ends the process."""

import ctypes
import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FORBIDDEN = 0  # PROT_NONE
_PAGE = mmap.PAGESIZE
_libc = ctypes.CDLL(None, use_errno=True)


def guarded(array: NDArray[Any], at_end: bool) -> NDArray[Any]:
    """Return a copy that ends right before such a page, or begins right behind one."""
    if array.nbytes == 0 or not array.flags.c_contiguous:
        return array
    size = -(-array.nbytes // _PAGE) * _PAGE
    memory = mmap.mmap(-1, size + 2 * _PAGE)
    whole = np.frombuffer(memory, np.uint8)
    for page in (0, _PAGE + size):
        if _libc.mprotect(ctypes.c_void_p(whole.ctypes.data + page), _PAGE, _FORBIDDEN):
            raise OSError(ctypes.get_errno(), "mprotect")
    first = _PAGE + (size - array.nbytes if at_end else 0)
    copy = np.ndarray(array.shape, array.dtype, memory, first)
    copy[...] = array
    return copy


def guarded_tree(value: Any, at_end: bool) -> Any:
    """Return the same tuples with every array in them guarded."""
    if isinstance(value, np.ndarray):
        return guarded(value, at_end)
    if isinstance(value, tuple):
        items = [guarded_tree(item, at_end) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value
