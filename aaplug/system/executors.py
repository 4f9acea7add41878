"""Worker pools: apply one function to many items, in threads or in processes.

Results come in the order of the items, and a pool reads only a few items ahead of its workers, so memory does not grow
with the number of items.  Leaving the loop early, also by an exception, ends the workers.
"""

import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from pickle import PicklingError
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch

from aaplug.system import groups
from aaplug.system.allocator import keep_freed_memory
from aaplug.system.errors import OutputError, UsageError, of_system, reason
from aaplug.system.locks import scratch
from aaplug.system.signals import end_as_worker

# Python's resource tracker removes what killed processes left; with this option it does not say so
QUIET_TRACKER = "ignore::UserWarning:multiprocessing.resource_tracker"

WORK_FILE_NAME = "work.pt"  # file with the function of the workers, in a folder of temporary files
PAYS_AFTER_SECONDS = 20.0  # two processes take five seconds to start, and save two fifths
WINDOWS_PROCESSES = 61  # that a pool can have there
ITEMS_PER_WORKER = 2  # waiting or at work, so that no worker is idle
SCENES_PER_WORKER = 4  # in memory; so many callers can share a cluster

T = TypeVar("T")
R = TypeVar("R")
Apply = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]  # like `map`, and each executor's


@runtime_checkable
class Executor(Protocol):
    """A pool of workers: threads, processes of this machine, or a cluster's (`system.cluster`)."""

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item."""
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
    """Fresh (spawned) processes, each with one torch thread.

    `work` is pickled once, to a file that all of them map, so it can hold a large scene; items and results travel
    through pipes.  A script whose own classes or functions are part of `work` is imported by each process, so it needs
    `if __name__ == "__main__":` around its calls.  What a notebook or a function defines no other process can import,
    so that such work is done in this one.

    ordered: true for results in the order of the items, false for results as they finish.
    """

    workers: int
    ordered: bool = True

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item.

        Raises:
            UsageError: a process died, for example for lack of memory.
            OutputError: there is no room for the file of `work`.
        """
        with scratch() as folder:
            path = folder / WORK_FILE_NAME
            try:
                save(work, path)
                needs = needs_script(path)
                alone = needs and not os.path.isfile(getattr(sys.modules["__main__"], "__file__", None) or "")
            except OfThisProcessError:
                needs = alone = True
            if alone:
                yield from map(work, items)
                return
            track_quietly()
            context = SpawnContext() if needs else _WithoutScript()
            workers = min(self.workers, WINDOWS_PROCESSES) if sys.platform == "win32" else self.workers
            pool = ProcessPoolExecutor(workers, context, _start, (str(folder),))
            try:
                most = ITEMS_PER_WORKER * workers
                yield from results(lambda item: pool.submit(_call, str(path), item), items, lambda: most, self.ordered)
            except (KeyboardInterrupt, GeneratorExit, SystemExit):  # the items at work need not be finished
                for process in getattr(pool, "_processes", None) or {}:
                    with suppress(OSError):
                        os.kill(process, signal.SIGTERM)
                raise
            except BrokenProcessPool as error:
                raise UsageError(
                    "worker process",
                    "died: out of memory (fewer threads need less), or started by a script "
                    'without `if __name__ == "__main__":`',
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)


class _ScriptlessProcess(SpawnProcess):
    """A spawned process that does not import the program's script, which would start the program again."""

    def start(self) -> None:
        main = vars(sys.modules["__main__"])
        script = {name: main[name] for name in ("__file__", "__spec__") if name in main}
        main.update(dict.fromkeys(script))  # where multiprocessing finds the script
        try:
            super().start()
        finally:
            main.update(script)


class _WithoutScript(SpawnContext):
    Process = _ScriptlessProcess


@dataclass(frozen=True)
class ProcessesIfLong:
    """Processes, if the first item says that more than `pays_after` seconds of work are left; else this one."""

    workers: int
    pays_after: float = PAYS_AFTER_SECONDS

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item, in order; errors as those of `Processes`."""
        all_of, started = list(items), time.perf_counter()
        yield from map(work, all_of[:1])
        others = all_of[1:]
        left = (time.perf_counter() - started) * len(others)
        workers = min(self.workers, len(others)) if left > self.pays_after else 1
        yield from (map if workers < 2 else Processes(workers).map)(work, others)


class _Given(threading.local):
    """torch's number of threads outside of a block that uses fewer of them; None outside of all blocks."""

    threads: int | None = None


_is_forked = False  # true in a process that began as a copy of another
_given = _Given()


def _begin_forked() -> None:
    """Draw with one thread in the copy of a process: it has no others of OpenMP's, and would wait for them."""
    global _is_forked
    _is_forked = True
    _given.threads = None
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_forked)


def given_threads() -> int:
    """The number of threads that torch may use, of which it uses fewer inside `cores.on_free_cores`."""
    return _given.threads or min(torch.get_num_threads(), groups.quota())


@contextmanager
def torch_threads(count: int, given: int | None = None) -> Iterator[None]:
    """Let torch use `count` threads inside the block; one in a forked process.

    given: what `given_threads` says inside; None for `count`.
    """
    before, before_given = torch.get_num_threads(), _given.threads
    torch.set_num_threads(1 if _is_forked else count)
    _given.threads = given
    try:
        yield
    finally:
        torch.set_num_threads(1 if _is_forked else before)  # it may have begun inside
        _given.threads = None if _is_forked else before_given


def results(
    submit: Callable[[T], Any], items: Iterable[T], most: Callable[[], int], ordered: bool = True
) -> Iterator[Any]:
    """Yield the results, with at most `most()` items submitted, each to a future, and not yet yielded."""
    waiting: deque[Any] = deque()
    for item in items:
        waiting.append(submit(item))
        if len(waiting) >= most():
            yield _next(waiting, ordered)
    while waiting:
        yield _next(waiting, ordered)


def _next(waiting: deque[Any], ordered: bool) -> Any:
    future = waiting[0] if ordered else next(iter(wait(waiting, return_when=FIRST_COMPLETED).done))
    waiting.remove(future)
    return future.result()


class OfThisProcessError(UsageError):
    """Something that no other process can import, such as a lambda."""


def save(work: object, path: Path) -> None:
    """Write the function of the workers.

    Raises:
        OutputError: there is no room for it.
        OfThisProcessError: it cannot be pickled.
    """
    try:
        with path.open("wb") as stream:
            torch.save(work, stream)
    except (OSError, RuntimeError) as error:
        if cause := of_system(error):
            raise OutputError(path, f"cannot be written: {reason(cause)}") from error
        raise
    except (PicklingError, AttributeError, TypeError) as error:
        problem = f"cannot be given what no module holds under its name, such as a lambda: {error}"
        raise OfThisProcessError("workers", problem) from error


def needs_script(path: Path) -> bool:
    """True if what `save` wrote names something of the program's script."""
    with zipfile.ZipFile(path) as archive:
        return any(b"__main__" in archive.read(name) for name in archive.namelist() if name.endswith("/data.pkl"))


@lru_cache(SCENES_PER_WORKER)
def load(path: str) -> Callable[[Any], Any]:
    """Return what `save` wrote, for a worker process; its tensors stay in the file until they are read."""
    keep_freed_memory()  # Dask forbids its workers, which takes most of their time
    return torch.load(path, mmap=True, weights_only=False)  # our own file


def track_quietly() -> None:
    """Start Python's resource tracker before the first worker does.

    It inherits the options of warnings, and that a closing terminal (HUP) does not end it before the workers.
    """
    if os.name != "posix":  # there is none
        return
    sys.warnoptions.append(QUIET_TRACKER)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        sys.warnoptions.remove(QUIET_TRACKER)


def _start(folder: str) -> None:
    """Begin a worker process, which ends with the parent if that dies without shutting the pool down."""

    def end_with_parent() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    end_as_worker()
    torch.set_num_threads(1)


def _call(path: str, item: Any) -> Any:
    try:
        return load(path)(item)
    except SystemExit as end:  # the pool would go on with the next item
        os._exit(end.code if isinstance(end.code, int) else 1)
