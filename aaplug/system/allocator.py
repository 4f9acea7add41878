"""The C library's allocator, set for a program that makes image after image."""

import ctypes
from contextlib import suppress
from functools import cache

M_MMAP_MAX = -4  # glibc's number of mallopt's parameter: number of blocks that come from the system by themselves
M_TRIM_THRESHOLD = -1  # likewise: bytes of free memory above which some goes back


@cache
def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next image; other C libraries stay as they are.

    Fetching it from the system anew takes a quarter of a frame of a million Gaussians.  For programs and workers of
    our own: it acts on the whole process.
    """
    with suppress(OSError, AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 1 << 30)
