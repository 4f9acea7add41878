"""The workers of a Dask cluster as an executor: a cluster on this machine, or any whose scheduler can be reached.

What workers do, which holds the scene, is written once to a folder that all machines see.  A worker maps that file when
its first item comes, and keeps it; only items and results pass through the scheduler.  An item whose worker dies is
done again elsewhere, so work must bear being done twice.
"""

import asyncio
import logging
import math
import os
import re
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import dask.config
import torch
from distributed import Client, Future, KilledWorker, LocalCluster, get_worker
from distributed.client import ClosedClientError
from distributed.comm.core import CommClosedError
from distributed.core import rpc
from distributed.security import Security
from distributed.utils import LoopRunner

from aaplug.system.errors import MAX_VALUE_CHARACTERS, ClusterError, UsageError, counted, listing, reason
from aaplug.system.executors import ITEMS_PER_WORKER, WORK_FILE_NAME, load, results, save, track_quietly
from aaplug.system.locks import scratch
from aaplug.system.monitor import Monitor

LOCAL = "local"  # in place of an address: a cluster on this machine, for the length of the call
SCHEDULER_ADDRESS = re.compile(r"\w+://\S+:\d+", re.ASCII)
ANSWER_SECONDS = 10.0  # a scheduler answers and has a worker by then
LOOK_SECONDS = 1.0  # between two counts of the workers
ABSENT_SECONDS = 60.0  # without any worker, after which the cluster counts as lost
VERSIONS = {package: version(package) for package in ("aaplug", "torch")}  # results depend on these
IGNORE_INTERRUPTS = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"  # the caller hears Ctrl-C
LEAN_WORKERS = {  # no variables that would stay in our own environment, too, and no sampling profiler
    "distributed.nanny.pre-spawn-environ": {},
    "distributed.worker.profile.enabled": False,
}
NOISY_LOGGERS = ("distributed", "tornado", "asyncio")  # the error says what they would write

T = TypeVar("T")
R = TypeVar("R")


@dataclass
class Cluster:
    """A connected cluster.

    name: its address, for messages.  folder: where all machines see files; None for this machine's temporary files.
    monitor: told how many workers there are, and which are lost.
    """

    client: Client
    name: str
    folder: Path | None
    monitor: Monitor
    threads: int = field(default=0, init=False)
    _workers: frozenset[str] = field(default=frozenset(), init=False)  # addresses at the last count
    _last_look: float = field(default=-math.inf, init=False)  # time of the last count of the workers
    _last_worker: float = field(default=math.inf, init=False)  # time of the last count above 0

    def map(self, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Yield `work(item)` of every item, in order.

        Raises:
            ClusterError: the scheduler or all workers are lost, or one has another version or does not see the folder.
            UsageError: the workers of one item died again and again.
            OutputError: there is no room for the file of `work`.
            OfThisProcessError: `work` cannot be pickled.
        """
        self._last_look, self._last_worker = -math.inf, time.monotonic()
        with scratch(self.folder and str(self.folder.absolute())) as folder, self.worded():
            save(work, folder / WORK_FILE_NAME)
            self.look()
            path = str(folder / WORK_FILE_NAME)

            def submit(item: T) -> "_Result[R]":
                return _Result(self, self.client.submit(_call, path, VERSIONS, item, pure=False))

            yield from results(submit, items, lambda: ITEMS_PER_WORKER * max(1, self.threads))

    def look(self) -> None:
        """Count the workers now and then, and tell of lost ones.

        Raises:
            ClusterError: the scheduler has gone, or all workers for long, or it does not answer.
        """
        if self.client.status != "running":
            raise self._lost()
        if time.monotonic() - self._last_look < LOOK_SECONDS:
            return
        try:
            present = cast(dict[str, int], self.client.nthreads(callback_timeout=ABSENT_SECONDS))  # by address
        except TimeoutError as error:
            raise ClusterError(f"scheduler {self.name}", f"has not answered for {ABSENT_SECONDS:.0f} s") from error
        if lost := self._workers - present.keys():
            these = f"{len(lost)} of {counted(len(self._workers), 'worker')} ({listing(sorted(lost))})"
            self.monitor.say(f"lost {these}; others do again what was begun there")
        self._workers, self.threads = frozenset(present), sum(present.values())
        self.monitor.working(len(present))
        self._last_look = time.monotonic()
        if self.threads:
            self._last_worker = self._last_look
        elif self._last_look - self._last_worker > ABSENT_SECONDS:
            raise ClusterError(f"scheduler {self.name}", f"has had no workers for {ABSENT_SECONDS:.0f} s")

    def _lost(self) -> ClusterError:
        again = "start it again, and repeat the command, with `resume` where it has one"
        return ClusterError(f"scheduler {self.name}", f"the connection is lost; {again}")

    def check(self) -> None:
        """Refuse workers with other versions, by their addresses."""
        for package, expected in VERSIONS.items():
            installed = cast(dict[str, Any], self.client.run(version, package, on_error="return"))
            for worker, result in sorted(installed.items()):
                if not isinstance(result, OSError):  # a worker that has gone meanwhile
                    _refuse_other(worker, package, result, expected)

    @contextmanager
    def worded(self) -> Iterator[None]:
        """Turn what Dask raises inside the block into an error of one line."""
        try:
            yield
        except KilledWorker as error:
            died = f"died {error.allowed_failures + 1} times at one item: out of memory, for example"
            raise UsageError(f"worker {error.last_worker.address}", died) from error
        except (CancelledError, CommClosedError, ClosedClientError) as error:
            raise self._lost() from error


@dataclass(frozen=True)
class _Result(Generic[R]):
    """A result to come; waiting for it counts the workers."""

    cluster: Cluster
    future: "Future[R]"

    def result(self) -> R:
        while True:
            self.cluster.look()
            try:
                return self.future.result(timeout=LOOK_SECONDS)
            except TimeoutError:
                if self.future.done():  # meanwhile, or the error is the item's own
                    return self.future.result()


@contextmanager
def connected(scheduler: str, threads: int, folder: Path | None, monitor: Monitor) -> Iterator[Cluster]:
    """Connect to a cluster for the length of the block.

    scheduler: "local" for one of `threads` processes on this machine; or an address such as tcp://host:8786.
    folder: see `Cluster`.

    Raises:
        UsageError: the address is none, or there is no folder.
        ClusterError: nothing answers there, it has no workers, or one has another version.
    """
    with _quietly(), ExitStack() as stack:
        if scheduler == LOCAL:
            processes = stack.enter_context(_local(threads, stack.enter_context(scratch())))
            cluster = Cluster(stack.enter_context(Client(processes)), LOCAL, None, monitor)
        else:
            if folder is None:
                raise UsageError("output", f"name a folder that the workers of {scheduler} see, too")
            cluster = Cluster(stack.enter_context(_client(scheduler)), scheduler, folder, monitor)
        with cluster.worded():
            try:
                cluster.client.wait_for_workers(1, timeout=ANSWER_SECONDS)
            except TimeoutError as error:
                raise ClusterError(f"scheduler {scheduler}", "has no workers; start some with `dask worker`") from error
            cluster.check()
        yield cluster


def _client(address: str) -> Client:
    if SCHEDULER_ADDRESS.fullmatch(address) is None:
        got = address[:MAX_VALUE_CHARACTERS]
        raise UsageError("scheduler", f"takes local or an address such as tcp://host:8786, got {got}")
    try:
        if (found := LoopRunner(asynchronous=False).run_sync(_kind, address)) != "Scheduler":
            raise ClusterError(f"scheduler {address}", f"a Dask {found.lower()} answers there, expected a scheduler")
        return Client(address, timeout=ANSWER_SECONDS, set_as_default=False)
    except OSError as error:
        raise ClusterError(f"scheduler {address}", f"nothing answers there within {ANSWER_SECONDS:.0f} s") from error
    except MemoryError as error:  # Dask takes the first word for a number of bytes
        raise ClusterError(f"scheduler {address}", "what answers there is not Dask") from error
    except (ValueError, TypeError, ImportError) as error:
        raise UsageError(f"scheduler {address}", f"Dask cannot connect so: {reason(error)}") from error


async def _kind(address: str) -> str:
    """What of Dask answers at an address; `Client` would wait for ever where something listens and says nothing."""
    arguments = Security().get_connection_args("client")
    async with asyncio.timeout(ANSWER_SECONDS), rpc(address, connection_args=arguments) as there:
        return cast(dict[str, Any], await there.identity())["type"]


def _local(workers: int, folder: Path) -> LocalCluster:
    """Processes of this machine, each with one thread and as much memory as there is."""
    track_quietly()
    try:
        with dask.config.set({**LEAN_WORKERS, "temporary-directory": str(folder)}):
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address=cast(str, None),
                memory_limit=0,
                silence_logs=logging.CRITICAL,
                preload=[IGNORE_INTERRUPTS],
            )
    except RuntimeError as error:
        raise ClusterError("worker process", 'did not start: a script needs `if __name__ == "__main__":`') from error


@contextmanager
def _quietly() -> Iterator[None]:
    """Keep Dask's log from the terminal inside the block; what matters is told by errors."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in NOISY_LOGGERS]
    before = {name: logging.getLogger(name).level for name in names}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        for name in before:
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for name, level in before.items():
                logging.getLogger(name).setLevel(level)


# The rest runs on the workers.

_one_item = threading.Lock()  # a worker with more threads does one item at a time: renderers are not made for two


def _refuse_other(worker: str, package: str, installed: object, expected: str) -> None:
    if installed != expected:
        got = f"{package} {installed}" if isinstance(installed, str) else f"no {package}"
        raise ClusterError(f"worker {worker}", f"has {got}, expected {expected}; install that there")


def _call(path: str, versions: dict[str, str], item: Any) -> Any:
    """The result of one item; a worker that came after the caller's check is checked here."""
    for package, expected in versions.items():
        _refuse_other(get_worker().address, package, VERSIONS[package], expected)
    if not os.path.exists(path):
        raise ClusterError(f"worker {get_worker().address}", f"does not see {path}: it needs the same file system")
    with _one_item:
        torch.set_num_threads(1)  # of this thread, and for good
        return load(path)(item)
