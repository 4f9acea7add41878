"""Cores that other programs leave free, and work with as many threads.

At the end of every parallel loop OpenMP's threads wait for the last one.  Where another program uses that one's core,
all wait for it, and work of many loops takes many times as long as by one thread.
"""

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from aaplug.system import groups
from aaplug.system.executors import given_threads, torch_threads

STATISTICS = Path("/proc/stat")  # Linux: clock ticks that each core spent in each state
WAITS = (3, 4)  # columns of the states idle and waiting for a disk
STATES = 8  # columns; those after them count time again
WINDOW_SECONDS = 0.1  # least time that an estimate takes: a clock tick is 0.01 s
WATCH_SECONDS = 10.0  # for which other programs, once seen, are watched closely
WAIT_SECONDS = 1.0  # without work of this process, after which what others did meanwhile counts again


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
    """Counts the cores of this process that no other program uses, within its container's quota.

    Once other programs are seen, their work counts only while this process works: one that takes turns with it, such as
    a browser that shows its images, leaves it all cores.
    """

    def __init__(self):
        self._blocks = list[None]()  # that are open: a list counts right in several threads
        self._before, self._others, self._watched_until = Reading.now(), 0.0, -math.inf
        self._seconds = self._work = 0.0  # since the last estimate: the time that counts, and others' work in it

    def count(self) -> int:
        """The number of free cores by the last estimate, at least 1."""
        free = round(len(os.sched_getaffinity(0)) - self._others) if self._before else os.cpu_count() or 1
        return max(1, min(free, groups.quota()))

    @contextmanager
    def watched(self) -> Iterator[None]:
        """A block of work, at whose edges others are looked at."""
        self._look(working=bool(self._blocks), edge=not self._blocks)
        self._blocks.append(None)
        try:
            yield
        finally:
            self._blocks.pop()
            self._look(working=True, edge=not self._blocks)

    def _look(self, working: bool, edge: bool) -> None:
        """Estimate the cores that others use.  working: since the reading before.  edge: of a time of work."""
        before, clock = self._before, time.perf_counter()
        watching = clock < self._watched_until
        if before is None or (clock - before.clock < WINDOW_SECONDS and not (watching and edge)):
            return
        now = Reading.now()
        if now is None:
            return
        self._before, seconds = now, now.clock - before.clock
        work = (now.cores - before.cores) - (now.own - before.own)
        if not watching or (not working and seconds >= WAIT_SECONDS):
            self._seconds, self._work = seconds, work
        elif working:
            self._seconds, self._work = self._seconds + seconds, self._work + work
        if self._seconds >= WINDOW_SECONDS:
            self._others = max(0.0, self._work / self._seconds)
            self._seconds = self._work = 0.0
            if round(self._others) and not watching:
                self._watched_until = now.clock + WATCH_SECONDS


FREE_CORES = FreeCores()


@contextmanager
def on_free_cores() -> Iterator[None]:
    """Let torch use as many of the threads that it was given inside the block as there are free cores.

    A block inside another counts anew.
    """
    given = given_threads()
    if given == 1:
        yield
        return
    with FREE_CORES.watched():
        threads = min(given, FREE_CORES.count())
        with nullcontext() if threads == torch.get_num_threads() else torch_threads(threads, given):
            yield
