"""Limits of this process by Linux's control groups, versions 1 and 2, as containers set them."""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
CONTROL_GROUPS = Path("/proc/self/cgroup")  # those of this process


def limits(controller: str, files: Sequence[str], old_files: Sequence[str]) -> Iterator[list[float]]:
    """Yield the numbers in these files, or in those of version 1, of each group that this process is in; -1 for none.

    Those above a group limit it, too.
    """
    for line in CONTROL_GROUPS.read_text().splitlines() if CONTROL_GROUPS.exists() else []:
        _, controllers, place = line.split(":", 2)
        if controllers == "" or controller in controllers.split(","):
            root, names = (ROOT / controller, old_files) if controllers else (ROOT, files)
            inner = root / place.lstrip("/")
            for folder in (inner, *inner.parents):
                with suppress(OSError, ValueError):  # it is not there
                    if folder.is_relative_to(root):
                        words = " ".join((folder / name).read_text() for name in names).split()
                        yield [-1.0 if word == "max" else float(word) for word in words]


@cache
def quota() -> int:
    """Cores whose time this process may take, a part counted as one; `sys.maxsize` where nothing limits it."""
    times = limits("cpu", ["cpu.max"], ["cpu.cfs_quota_us", "cpu.cfs_period_us"])  # in each period
    return math.ceil(min((most / period for most, period in times if most > 0), default=sys.maxsize))
