"""Dask clusters of real processes: the bytes of one process, whoever is killed; and what is refused."""

import asyncio
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.metadata import version
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import aaplug
from aaplug.evaluation.journal import Journal
from aaplug.system.errors import ClusterError, FormatError, UsageError
from aaplug.system.extras import install_command
from aaplug.system.locks import SCRATCH_PREFIX, remove_left
from aaplug.system.monitor import SILENT, Monitor
from tests.test_batch import timeless
from tests.work import deadly_once, refuse_three

cluster = pytest.importorskip("aaplug.system.cluster")  # its package is an extra

SETTINGS = "--cameras . --views all --recipe matched --scale 0.5 1 --rasterizer eager --layout inria"
KILLED_CLIENT = """
import os, signal, sys
from itertools import count
from aaplug.evaluation.journal import Journal
from aaplug_cli.main import main
calls, add = count(), Journal.add
def dying(*line):
    add(*line)
    if next(calls) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
Journal.add = dying
main(sys.argv[1:])
"""


class Counting(Monitor):
    """Remembers how many workers there were, and what was said."""

    def __init__(self) -> None:
        self.workers, self.said = set[int](), list[str]()

    def say(self, text: str) -> None:
        self.said.append(text)

    def working(self, workers: int) -> None:
        self.workers.add(workers)


@contextmanager
def started(*words: str) -> Iterator[subprocess.Popen[str]]:
    """A process of Dask."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *words[1:], "--no-dashboard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def line_of(process: subprocess.Popen[str], said: str) -> str:
    """The line of a process's log that holds these words; waits for it."""
    return next(line for line in process.stderr or () if said in line)


@pytest.fixture(scope="module")
def started_locally(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A cluster of one process of this machine, which leaves no temporary file."""
    temporary = tmp_path_factory.mktemp("temporary")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(temporary))
        with cluster.connected("local", 1, None, Counting()) as processes:
            yield processes
    assert not [*temporary.iterdir()]


@pytest.fixture
def local(started_locally: Any) -> Any:
    """That cluster, whose process is there; another test may have killed it."""
    started_locally.client.wait_for_workers(1)
    return started_locally


def test_whoever_is_killed_the_bytes_are_those_of_one_process(cli, monkeypatch):
    cli.done(f"evaluate scene.ply {SETTINGS} -o one")
    whole = timeless(Path("one"))
    with ExitStack() as stack:
        master = stack.enter_context(started("scheduler", "--port", "0", "--host", "127.0.0.1"))
        address = line_of(master, "Scheduler at:").split()[-1]
        how = ("--nthreads", "1", "--memory-limit", "0", "--no-nanny")
        workers = [stack.enter_context(started("worker", address, *how)) for _ in range(2)]
        for worker in workers:
            line_of(worker, "Registered to")
        words = f"evaluate scene.ply {SETTINGS} -o out --scheduler {address}"

        def run(killed: subprocess.Popen[str]) -> tuple[int, str]:
            """Exit code and last line of a run in which a process is killed after the first view."""
            shutil.rmtree("out", ignore_errors=True)
            add = Journal.add
            with monkeypatch.context() as patch:
                patch.setattr(Journal, "add", lambda *line: (add(*line), killed.kill()))
                code, _, err = cli(words)
            return code, err.splitlines()[-1]

        assert run(workers[0])[0] == 0
        assert timeless(Path("out")) == whole

        shutil.rmtree("out")
        client = subprocess.run([sys.executable, "-c", KILLED_CLIENT, *words.split()], capture_output=True, check=False)
        assert client.returncode == -signal.SIGKILL, client.stderr
        assert len(Path("out/progress.jsonl").read_text().splitlines()) == 3
        remove_left.cache_clear()
        cli.done(f"{words} --resume")
        assert timeless(Path("out")) == whole
        assert not list(Path("out").glob(f"{SCRATCH_PREFIX}*"))

        lost = "the connection is lost; start it again, and repeat the command, with --resume where it has one"
        assert run(master) == (2, f"error: scheduler {address}: {lost}")
        assert len(Path("out/progress.jsonl").read_text().splitlines()) == 2
        cli.done(f"evaluate scene.ply {SETTINGS} -o out --resume")
        assert timeless(Path("out")) == whole


def test_scenes_are_converted_and_images_and_videos_made_to_the_same_bytes(local, cli):
    def made(folder: str, **given: Any) -> list[bytes]:
        Path(folder).mkdir()
        how = {"rasterizer": "eager", "scale": 0.5, **given}
        aaplug.render("scene.ply", ".", f"{folder}/images", views="all", **how)
        aaplug.video("scene.ply", ".", f"{folder}/v.webm", seconds=0.1, beside=None, **how)
        return [path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()]

    local.monitor.workers.clear()  # another test may have killed the one
    assert made("out", scheduler=local) == made("one")
    assert local.monitor.workers == {1}
    Path("many.toml").write_text(
        "[[scene]]\nscene = 'scene.ply'\ncameras = '.'\n[[scene]]\nname = 'b'\nscene = 'scene.ply'\n"
        "cameras = '.'\nvariance = 0.1\n"
    )
    cli.done("convert --batch many.toml -o here")
    cli.done(f"convert --batch many.toml -o there --scheduler {local.client.scheduler.address}")
    for name in ("scene.ply", "b.ply"):
        assert Path("here", name).read_bytes() == Path("there", name).read_bytes()


def test_items_come_in_order_until_the_first_error_and_few_are_read_ahead(local):
    results, items = [], count()
    with pytest.raises(FormatError, match=r"scene\.ply: is short"):
        results.extend(local.map(refuse_three, items))
    assert results == [0, 1, 4]
    assert next(items) <= 6


def test_a_worker_with_another_version_is_refused_by_name(local, monkeypatch):
    monkeypatch.setitem(cluster.VERSIONS, "aaplug", "9.9")
    found = rf"worker tcp://127\.0\.0\.1:\d+: has aaplug {version('aaplug')}, expected 9\.9; install that there"
    with pytest.raises(UsageError, match=found):
        local.check()
    with pytest.raises(UsageError, match=found):  # a worker that came after that check
        list(local.map(refuse_three, [1]))
    monkeypatch.setattr(cluster, "VERSIONS", {"no-such-package": "1"})
    with pytest.raises(UsageError, match="has no no-such-package, expected 1"):
        local.check()


@contextmanager
def answering(text: bytes) -> Iterator[str]:
    """Address of a program that says this to its first caller."""

    def answer() -> None:
        with server.accept()[0] as caller, suppress(OSError):
            caller.sendall(text)
            while caller.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


def test_what_answers_and_is_no_scheduler_is_told(local, tmp_path, monkeypatch):
    with answering(b"") as silent, answering(b"HTTP/1.0") as page:
        for address, problem, seconds in (
            (page, "what answers there is not Dask", cluster.ANSWER_SECONDS),
            (min(local.client.nthreads()), "a Dask worker answers there, expected a scheduler", cluster.ANSWER_SECONDS),
            (silent, "nothing answers there within 0 s", 0.2),
        ):
            monkeypatch.setattr(cluster, "ANSWER_SECONDS", seconds)
            with pytest.raises(ClusterError, match=f"scheduler {address}: {problem}"):
                cluster.connected(address, 0, tmp_path, SILENT).__enter__()


def test_a_scheduler_that_does_not_answer_or_has_no_workers_is_lost_after_a_while(local, monkeypatch):
    with monkeypatch.context() as silent:
        silent.setattr(cluster, "ABSENT_SECONDS", 0.05)
        silent.setattr(local.client.scheduler, "ncores", lambda workers: asyncio.sleep(2), raising=False)
        with pytest.raises(ClusterError, match="scheduler local: has not answered for 0 s"):
            list(local.map(refuse_three, [1]))
    monkeypatch.setattr(local.client, "nthreads", lambda **how: {})
    assert list(local.map(refuse_three, [1])) == [1]
    monkeypatch.setattr(cluster, "ABSENT_SECONDS", -1.0)
    with pytest.raises(UsageError, match="scheduler local: has had no workers for"):
        list(local.map(refuse_three, [1]))


def test_an_item_whose_worker_dies_is_done_again_unless_it_kills_all(local, tmp_path, monkeypatch):
    assert list(local.map(partial(deadly_once, tmp_path / "died"), range(4))) == [0, 1, 4, 9]
    said = local.monitor.said[-1]
    assert re.fullmatch(r"lost 1 of 1 worker \(tcp://127.0.0.1:\d+\); others do again what was begun there", said)
    monkeypatch.setattr(local.client.cluster.scheduler, "allowed_failures", 0)
    with pytest.raises(UsageError, match=r"worker tcp://\S+: died 1 times at one item: out of memory"):
        list(local.map(os._exit, [3]))


def test_a_worker_that_does_not_see_the_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(cluster, "get_worker", lambda: SimpleNamespace(address="tcp://far:1"))
    with pytest.raises(UsageError, match=r"worker tcp://far:1: does not see .*work\.pt: it needs the same file system"):
        cluster._call(str(tmp_path / "work.pt"), cluster.VERSIONS, None)


def test_a_cluster_without_workers_or_without_a_folder_is_refused(monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_SECONDS", 0.1)
    folder = "output: name a folder that the workers of tcp://far:1 see, too"
    for scheduler, said in (("local", "scheduler local: has no workers; start some"), ("tcp://far:1", folder)):
        with pytest.raises(UsageError, match=said):
            cluster.connected(scheduler, 0, None, SILENT).__enter__()


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:9", "scheduler tcp://127.0.0.1:9: nothing answers there within 0 s"),
        ("nowhere", "--scheduler: takes local or an address such as tcp://host:8786, got nowhere"),
    ],
)
def test_a_scheduler_that_is_not_there_is_one_line(address, said, cli, monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_SECONDS", 0.2)
    line = cli.refused(f"render scene.ply --cameras . -o out --rasterizer eager --scheduler {address}")
    assert line == f"error: {said}"


def test_without_the_extra_its_name_is_told(cli, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = f"error: --scheduler: needs the extra `cluster`: {install_command('cluster')}"
    assert cli.refused("render scene.ply --cameras . -o out --rasterizer eager --scheduler local") == said
