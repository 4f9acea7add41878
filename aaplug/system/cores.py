"""Cores that other programs leave free, and work with as many threads.

At the end of every parallel loop OpenMP's threads wait for the last one.  Where another program uses that one's core,
all wait for it, and work of many loops takes many times as long as by one thread.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from aaplug.system import groups
from aaplug.system.executors import given_threads, torch_threads

STATISTICS = Path("/proc/stat")  # Linux: clock ticks that each core spent in each state
WAITS = (3, 4)  # columns of the states idle and waiting for a disk
STATES = 8  # columns; those after them count time again
WINDOW_SECONDS = 0.1  # least time between two readings: a clock tick is 0.01 s


@dataclass(frozen=True)
class Reading:
    """Seconds since an arbitrary start: of the clock, of work of this process's threads, of work of all its cores."""

    clock: float
    own: float
    cores: float

    @staticmethod
    def now() -> "Reading | None":
        """The present one; None where the system does not tell."""
        with suppress(OSError, ValueError, AttributeError):
            allowed = {f"cpu{core}" for core in os.sched_getaffinity(0)}
            lines = (line.split() for line in STATISTICS.read_text().splitlines() if line.startswith("cpu"))
            states = [list(map(int, numbers[:STATES])) for name, *numbers in lines if name in allowed]
            ticks = sum(sum(state) - sum(state[i] for i in WAITS) for state in states)
            return Reading(time.perf_counter(), time.process_time(), ticks / os.sysconf("SC_CLK_TCK"))


class FreeCores:
    """Counts the cores of this process that no other program uses, within its container's quota."""

    def __init__(self):
        self._before, self._others = Reading.now(), 0.0

    def count(self) -> int:
        """The number of free cores, at least 1, measured since the reading before."""
        before = self._before
        if before is not None and time.perf_counter() - before.clock >= WINDOW_SECONDS:
            now = self._before = Reading.now()
            if now is not None:
                work = (now.cores - before.cores) - (now.own - before.own)
                self._others = max(0.0, work / (now.clock - before.clock))
        free = round(len(os.sched_getaffinity(0)) - self._others) if before else os.cpu_count() or 1
        return max(1, min(free, groups.quota()))


FREE_CORES = FreeCores()


@contextmanager
def on_free_cores() -> Iterator[None]:
    """Let torch use as many of the threads that it was given inside the block as there are free cores.

    A block inside another counts anew.
    """
    given = given_threads()
    threads = min(given, FREE_CORES.count()) if given > 1 else given
    if threads == torch.get_num_threads():
        yield
    else:
        with torch_threads(threads, given):
            yield
