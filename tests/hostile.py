"""Reads hostile files in child processes with limits on memory and time.

A child process is forked once a batch, after everything is imported, and may take `MEMORY` more address space than it
has.  Each file must end as a scene or in one of our errors, within `SECONDS` and `GROWTH` of resident memory.
"""

import multiprocessing
import os
import random
import resource
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import jaxtyping
import torch

from aaplug import AaplugError, read_scene
from aaplug.evaluation.coverage import survey
from tests.scene_files import DATA, MADE, SEVERAL, STORED, write_file

SECONDS = 1.0  # of processor time a file; other processes may make the clock's run longer
GROWTH = 100 * 2**20  # bytes of resident memory beyond what the program itself has, which is about 200 MB
MEMORY = 2**30  # bytes of address space beyond what the worker has when it starts
BATCH = 500  # files a child
NAMES = (*STORED, "run.pt", *MADE, *SEVERAL)


@dataclass(frozen=True)
class Target:
    """A small file to damage, and its reader.

    make: writes it and what belongs beside it into an empty folder; returns its path.
    environment: variables that are set while it is read.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    environment: Mapping[str, str] = field(default_factory=dict)

    def content(self) -> bytes:
        """The file as it is whole."""
        with tempfile.TemporaryDirectory() as folder:
            return self.make(Path(folder)).read_bytes()


def read_as_info_does(path: Path) -> None:
    """Open a scene and look at every Gaussian."""
    survey(read_scene(path, allow_checkpoint=True))


def scene(name: str) -> Target:
    """A small scene of the format that the name tells."""

    def make(folder: Path) -> Path:
        path = folder / name
        if "/" in name:
            shutil.copytree((DATA / name).parent, path.parent)
        elif name in NAMES:
            content = write_file(folder, name).read_bytes()
            path.write_bytes(content)
        return path

    return Target(make, read_as_info_does)


def outcome(path: Path, read: Callable[[Path], object] = read_as_info_does) -> str:
    """Read a file: "read", "refused", or what went wrong."""
    try:
        read(path)
    except AaplugError as error:
        str(error).encode()
        return "refused" if "\n" not in str(error) else f"two lines: {error!r}"
    except BaseException as error:
        return f"{type(error).__name__}: {error!r:.200}"
    return "read"


def mutations(data: bytes, seed: int, count: int) -> Iterator[bytes]:
    """Copies with bytes flipped, replaced, cut out, doubled, and digits and lengths changed."""
    rng = random.Random(seed)
    for _ in range(count):
        spoiled = bytearray(data)
        for _ in range(rng.choice((1, 1, 2, 4, 8))):
            spoiled = _spoil(spoiled, rng)
        yield bytes(spoiled)


def check(name: str, files: Iterable[bytes], target: Target | None = None) -> Counter[str]:
    """Read each of these as the target, or as a scene of that name, in children; counts of outcomes.

    Raises:
        AssertionError: a file did harm.
    """
    outcomes, files = Counter[str](), iter(files)
    while batch := list(islice(files, BATCH)):
        outcomes += _in_a_child(name, batch, target or scene(name))
    return outcomes


def _spoil(data: bytearray, rng: random.Random) -> bytearray:
    at = rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(min(len(data), 300) + 1)
    kind = rng.randrange(6)
    if kind == 0 and at < len(data):
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        data[at : at + rng.randrange(9)] = rng.randbytes(rng.randrange(9))
    elif kind == 2:
        del data[at : at + rng.choice((1, 4, 16, len(data) // 2))]
    elif kind == 3:
        data[at:at] = data[at : at + rng.choice((1, 4, 16, 256))]
    elif kind == 4:
        data[at : at + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80"))
    else:
        data[at : at + 1] = rng.choice((b"0", b"9", b"99999999", b"-1", b" ", b"\n", b"1e9", b"\0"))
    return data


def _in_a_child(name: str, files: list[bytes], target: Target) -> Counter[str]:
    receive, send = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=_work, args=(target, files, send))
    child.start()
    send.close()
    try:
        outcomes, slowest, growth, left = receive.recv()
    except EOFError:
        child.join()
        raise AssertionError(f"{name}: the reader died with {child.exitcode}") from None
    child.join()
    strange = {key: n for key, n in outcomes.items() if key not in ("read", "refused")}
    assert not strange, (name, strange)
    assert slowest < SECONDS, (name, slowest)
    assert growth < GROWTH, (name, growth)
    assert not left, (name, left)
    return outcomes


def _work(target: Target, files: list[bytes], send) -> None:
    torch.set_num_threads(1)
    jaxtyping.config.update("jaxtyping_disable", True)  # as users run it
    os.environ.update(target.environment)
    space = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (space + MEMORY, space + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    outcomes, slowest = Counter[str](), 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = target.make(Path(folder))
        outcome(path, target.read)  # reads the code, too, which counts as memory of a fork
        before = _resident()
        there = sorted(p.name for p in path.parent.iterdir())
        for data in files:
            path.write_bytes(data)
            start = time.process_time()
            outcomes[outcome(path, target.read)] += 1
            slowest = max(slowest, time.process_time() - start)
        left = [p.name for p in path.parent.iterdir() if p.name not in (*there, path.name)]
    send.send((outcomes, slowest, _resident() - before, left))


def _resident() -> int:
    """Most resident memory so far of this process, a fork's own."""
    words = Path("/proc/self/status").read_text().split()
    return int(words[words.index("VmHWM:") + 1]) * 1024
