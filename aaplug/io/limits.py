"""Limits on what a file may make a reader allocate; `aaplug info --limits` prints them.

The environment variable AAPLUG_<NAME> overrides a limit: AAPLUG_GAUSSIANS=2e8.  Most of them answer failures of other
readers: counts that allocate terabytes, decompression bombs, endless headers.
"""

import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from aaplug.system import groups
from aaplug.system.errors import UsageError

SAMPLE_BYTES = 32.0  # per sample of an image: red, green, blue and alpha in float32, and a copy
UNCHECKED_SAMPLES = 1 << 26  # of an image, up to which memory is not checked
STATM = Path("/proc/self/statm")  # pages of memory that it uses


@dataclass(frozen=True)
class Limit:
    """The largest accepted value of something."""

    value: int | float
    unit: str
    what: str


LIMITS: Mapping[str, Limit] = {
    "HEADER": Limit(128 * 2**10, "bytes", "a .ply's header; scenes have about 2 KB"),
    "HEADER_LINES": Limit(1000, "lines", "a .ply's header; scenes have about 70"),
    "GAUSSIANS": Limit(1e8, "Gaussians", "of a scene; about 25 GB as .ply"),
    "MEMORY_SHARE": Limit(0.5, "of RAM", "that a scene read whole, or a job, may take"),
    "JSON": Limit(64 * 2**20, "bytes", "a JSON file"),
    "CFG_ARGS": Limit(64 * 2**10, "bytes", "INRIA's cfg_args"),
    "NAME": Limit(4096, "bytes", "a photograph's name"),
    "IMAGE": Limit(2**28, "px", "an image; 16384 x 16384"),
    "IMAGE_EXTRA": Limit(64 * 2**20, "bytes", "of an image's file beyond 8 a pixel: previews, metadata"),
    "CAMERA_SIDE": Limit(65536, "px", "a side of a camera's image"),
    "INFLATE": Limit(200, "times", "growth of a compressed member; gzip and zstd streams are held to the "
                     "size that their header announces"),
    "SLACK": Limit(64 * 2**10, "bytes", "what an inflated stream may hold beyond that"),
    "CHECKPOINT": Limit(32 * 2**30, "bytes", "a .pt checkpoint"),
}  # fmt: skip


def limit(name: str) -> int | float:
    """The limit in force; raises UsageError if the environment variable is not a positive number."""
    variable = f"AAPLUG_{name}"
    text = os.environ.get(variable)
    if text is None:
        return LIMITS[name].value
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0:
        raise UsageError(variable, f"should be a number above 0, not {text!r}")
    return value


def whole_limit(name: str) -> int:
    """The limit in force, as an integer."""
    return int(min(limit(name), 2**62))


def lack_of_memory(needed: int | float) -> str | None:
    """The reason that this process cannot hold so many bytes, in words; None if it can, or its memory is unknown."""
    memory, share = usable_memory(), limit("MEMORY_SHARE")
    if memory is None or needed <= share * memory[0]:
        return None
    return f"{needed / 1e9:.1f} GB, more than {share:.0%} of {memory[1]}"


def lack_for_samples(count: int) -> str | None:
    """The reason that this process cannot hold an image of so many samples, as `lack_of_memory`."""
    return lack_of_memory(SAMPLE_BYTES * count) if count > UNCHECKED_SAMPLES else None


def usable_memory() -> tuple[float, str] | None:
    """The bytes that machine, container and `ulimit -v` leave to this process, and in words; None if nobody says."""
    candidates = []
    with suppress(AttributeError, ValueError, OSError):
        machine = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
        candidates.append((machine, "this machine's {}"))
    for [most] in groups.limits("memory", ["memory.max"], ["memory.limit_in_bytes"]):
        if most >= 0:
            candidates.append((most, "this container's {}"))
    with suppress(ImportError, OSError):
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_AS)
        if most != resource.RLIM_INFINITY:
            pages = int(STATM.read_text().split()[0]) if STATM.exists() else 0
            left = max(0.0, float(most - pages * os.sysconf("SC_PAGE_SIZE")))
            candidates.append((left, "the {} that `ulimit -v` leaves"))
    least, words = min(candidates, default=(0.0, ""))
    return (least, words.format(f"{least / 1e9:.1f} GB")) if words else None
