"""Worker pools: apply one function to many items, in threads or in processes.

Results come in the order of the items, and a pool reads only a few items ahead of its workers, so memory does not grow
with the number of items.  Leaving the loop early, also by an exception, ends the workers.
"""

import multiprocessing
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch

from aaplug.core.allocator import keep_freed_memory
from aaplug.core.errors import OutputError, UsageError, of_system, reason
from aaplug.core.locks import scratch

# an option of Python: its resource tracker removes what killed processes left, and need not say so
QUIET = "ignore::UserWarning:multiprocessing.resource_tracker"

WORK = "work.pt"  # the file in the folder of temporary files that holds what workers do
PAYS_AFTER = 20.0  # seconds of work left: two processes take five to start, and save two fifths
AHEAD = 2  # items a worker that wait or are at work, so that none is idle

T = TypeVar("T")
R = TypeVar("R")
Result = TypeVar("Result", covariant=True)
Apply = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # like `map`, and each executor's


@runtime_checkable
class Executor(Protocol):
    """A pool of workers: threads, processes of this machine, or a cluster's (`core.cluster`)."""

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item."""
        ...


class Pending(Protocol[Result]):
    """A result to come."""

    def result(self) -> Result:
        """Wait for it."""
        ...


@dataclass(frozen=True)
class Threads:
    """Threads of this process, each with one torch thread.  At most one item per thread waits."""

    workers: int

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item, in order."""
        pool = ThreadPoolExecutor(self.workers, initializer=torch.set_num_threads, initargs=(1,))
        with torch_threads(1), pool:
            try:
                yield from results(lambda item: pool.submit(work, item), items, lambda: self.workers + 1)
            finally:
                pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class Processes:
    """Fresh (spawned) processes.

    `work` is pickled once, to a file that all of them map, so it can hold a large scene; items and results travel
    through pipes.  A script that uses processes needs `if __name__ == "__main__":` around its calls.

    torch_threads: of each process; None leaves torch's default.
    ordered: whether results come in the order of the items, or else as they finish.
    """

    workers: int
    torch_threads: int | None = 1
    ordered: bool = True

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item.

        Raises:
            UsageError: a process died, for example for lack of memory.
            OutputError: there is no room for the file of `work`.
        """
        with scratch() as folder:
            save(work, folder / WORK)
            start = (str(folder), self.torch_threads)
            track_quietly()
            spawn = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(self.workers, spawn, _start, start)
            try:
                most = AHEAD * self.workers
                yield from results(lambda i: pool.submit(_call, i), items, lambda: most, self.ordered)
            except BrokenProcessPool as error:
                raise UsageError(
                    "worker process",
                    "died: out of memory (fewer threads need less), or started by a script "
                    'without `if __name__ == "__main__":`',
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class ProcessesIfLong:
    """Processes, if the first item says that more than `pays_after` seconds of work are left; else this one."""

    workers: int
    pays_after: float = PAYS_AFTER

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item, in order; errors as those of `Processes`."""
        first, *others = items
        started = time.perf_counter()
        yield work(first)
        left = (time.perf_counter() - started) * len(others)
        workers = min(self.workers, len(others)) if left > self.pays_after else 1
        yield from (map if workers < 2 else Processes(workers).map)(work, others)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def results(
    submit: Callable[[T], Pending[R]], items: Iterable[T], most: Callable[[], int], ordered: bool = True
) -> Iterator[R]:
    """The results, with at most `most()` items submitted and not yet yielded."""
    waiting: deque[Any] = deque()
    for item in items:
        waiting.append(submit(item))
        if len(waiting) >= most():
            yield _next(waiting, ordered)
    while waiting:
        yield _next(waiting, ordered)


def _next(waiting: deque[Any], ordered: bool) -> Any:
    done = waiting[0] if ordered else next(iter(wait(waiting, return_when=FIRST_COMPLETED).done))
    waiting.remove(done)
    return done.result()


def save(work: object, path: Path) -> None:
    """Write what workers do; raises OutputError if there is no room for it."""
    try:
        with path.open("wb") as stream:
            torch.save(work, stream)
    except (OSError, RuntimeError) as error:
        if cause := of_system(error):
            raise OutputError(path, f"cannot be written: {reason(cause)}") from error
        raise


def loaded(path: str | Path) -> Callable[[Any], Any]:
    """What was saved; its tensors stay in the file until they are read."""
    return torch.load(path, mmap=True, weights_only=False)  # our own file


def track_quietly() -> None:
    """Start Python's resource tracker, which inherits the options of warnings, before the first worker does."""
    if os.name != "posix":  # there is none
        return
    sys.warnoptions.append(QUIET)
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(QUIET)


_work: Callable[[Any], Any] | None = None  # what this worker process does


def _start(folder: str, threads: int | None) -> None:
    """Begin a worker process: load the work, and watch the parent."""
    global _work
    threading.Thread(target=_end_with_parent, args=(folder,), daemon=True).start()
    keep_freed_memory()
    if threads is not None:
        torch.set_num_threads(threads)
    _work = loaded(Path(folder) / WORK)


def _end_with_parent(folder: str) -> None:
    """End this process when its parent has died without shutting the pool down."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def _call(item: Any) -> Any:
    assert _work is not None
    return _work(item)
