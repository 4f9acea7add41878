"""The C library's allocator, set for a program that makes image after image."""

import ctypes
from contextlib import suppress
from functools import cache

# of mallopt: M_MMAP_MAX, how many blocks come from the system by themselves, and M_TRIM_THRESHOLD, in bytes
KEPT = {-4: 0, -1: 1 << 30}


@cache
def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next image; other C libraries stay as they are.

    Fetching it from the system anew takes a quarter of a frame of a million Gaussians.  For programs and workers of
    our own: it acts on the whole process.
    """
    with suppress(OSError, AttributeError, TypeError):
        for parameter, value in KEPT.items():
            ctypes.CDLL(None).mallopt(parameter, value)
