"""Worker pools: results in order, few items read ahead, errors that come back whole, no worker outlives its parent."""

import os
import platform
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import chain, count
from pathlib import Path
from threading import Lock, Thread
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import psutil
import pytest
import torch

import aaplug
from aaplug import Monitor, Renderer
from aaplug.core.kernels import Kernel, Kernels
from aaplug.evaluation.laws.base import make_camera, make_scene
from aaplug.io.image_formats import Storage
from aaplug.rasterizers.tiled import Tiled
from aaplug.rendering.frames import write_frames
from aaplug.system import groups
from aaplug.system.cores import FREE_CORES, FreeCores, Reading, on_free_cores
from aaplug.system.errors import FormatError, OutputError, UsageError, within_memory
from aaplug.system.executors import Processes, ProcessesIfLong, Threads, given_threads, save, torch_threads
from tests.conftest import ALL_RASTERIZERS, ROOT, SAMPLE, files_of_at_most, run_python
from tests.work import refuse_three


def test_what_a_notebook_defines_is_done_without_processes(stand_in):
    """No other process could import it."""
    notebook = stand_in("__main__")
    exec("import os\ndef where(item): return item, os.getpid()", vars(notebook))
    assert [*Processes(2).map(notebook.where, range(3))] == [(item, os.getpid()) for item in range(3)]


@pytest.mark.parametrize("held", [lambda: 0, Lock()], ids=["lambda", "lock"])
def test_what_cannot_be_pickled_is_done_without_processes(held, tmp_path):
    work = partial(lambda held, item: (item, os.getpid()), held)
    assert [*Processes(2).map(work, range(3))] == [(item, os.getpid()) for item in range(3)]
    with pytest.raises(UsageError, match=r"^workers: cannot be given .* such as a lambda: "):
        save(work, tmp_path / "work.pt")


@pytest.mark.parametrize("executor", [Threads(2), Processes(2)], ids=lambda executor: type(executor).__name__)
def test_results_come_in_order_until_the_first_error(executor, tmp_path, stand_in):
    (tmp_path / "without_guard.py").write_text("raise SystemExit")  # as it would run again in each process
    stand_in("__main__", __file__=str(tmp_path / "without_guard.py"))
    results = []
    with pytest.raises(FormatError) as error:
        results.extend(executor.map(refuse_three, range(6)))
    assert results == [0, 1, 4]
    assert (error.value.where, error.value.problem) == ("scene.ply", "is short")


def test_threads_read_few_items_ahead():
    items = count()
    results = Threads(2).map(str, items)
    assert next(results) == "0"
    assert next(items) <= 3
    results.close()


def test_a_process_that_dies_is_one_clear_error():
    with pytest.raises(UsageError, match="worker process: died"):
        list(Processes(1).map(os._exit, [3]))


def test_no_more_processes_are_asked_for_than_windows_takes(monkeypatch):
    windows = SimpleNamespace(**{**vars(sys), "platform": "win32"})
    for module in ("concurrent.futures.process", "aaplug.system.executors"):
        monkeypatch.setattr(f"{module}.sys", windows)
    monkeypatch.setattr(ProcessPoolExecutor, "submit", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        list(Processes(128).map(abs, [1]))


def test_a_disk_that_is_full_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    said = r"work\.pt: cannot be written: file too large$"
    with files_of_at_most(100_000), pytest.raises(OutputError, match=said):
        list(Processes(1).map(partial(torch.add, torch.zeros(10**6)), [1]))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_kept_memory_is_not_fetched_again():
    script = """if True:
        import resource, sys
        from aaplug.system.allocator import keep_freed_memory
        if sys.argv[1] == "kept":
            keep_freed_memory()
        for _ in range(2):
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
            for _ in range(5):
                several = [bytearray(20_000_000) for _ in range(5)]
                del several
        print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
    """
    kept, usual = (int(run_python(script, how).stdout) for how in ("kept", "usual"))
    assert kept < usual / 10


class Machine:
    """Two cores and a clock.  waits, frame: cores that others use while this process waits, and in its 50 ms frames."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, waits: float, frame: float):
        self.waits, self.frame, self.reading = waits, frame, Reading(0.0, 0.0, 0.0)
        monkeypatch.setattr(Reading, "now", lambda: self.reading)
        monkeypatch.setattr("aaplug.system.cores.time", SimpleNamespace(perf_counter=lambda: self.reading.clock))
        monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 1}, raising=False)
        self.cores = FreeCores()

    def passes(self, seconds: float, own: float, others: float) -> None:
        before = self.reading
        self.reading = Reading(
            before.clock + seconds, before.own + own * seconds, before.cores + (own + others) * seconds
        )

    def threads(self, frames: int, pause: float = 0.05) -> list[int]:
        """The threads of each of some frames."""
        counts = []
        for _ in range(frames):
            self.passes(pause, 0.0, self.waits)
            with self.cores.watched():
                counts.append(self.cores.count())
                self.passes(0.05, 2.0 - self.frame, self.frame)
        return counts


def test_threads_leave_a_core_to_another_program_until_it_ends(monkeypatch):
    machine = Machine(monkeypatch, waits=1.0, frame=1.0)
    assert machine.threads(1000)[2:] == 998 * [1]
    machine.waits = machine.frame = 0.0
    assert machine.threads(1000)[4:] == 996 * [2]
    machine.waits = machine.frame = 1.0
    assert machine.threads(1, pause=60.0) == [1]


def test_a_program_that_takes_turns_with_this_one_leaves_it_all_cores(monkeypatch):
    assert Machine(monkeypatch, waits=2.0, frame=0.0).threads(1000).count(2) > 970


@pytest.mark.parametrize(
    ("lines", "files", "expected"),
    [
        ("0::/job\n", {"job/cpu.max": "150000 100000\n", "cpu.max": "max 100000\n"}, 2),
        ("0::/job\n", {"job/cpu.max": "max 100000\n", "cpu.max": "300000 100000\n"}, 3),
        ("1:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "50000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 1),
        ("1:cpu:/\n0::/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ("4:memory:/\n", {"cpu.max": "100000 100000\n"}, 8),
    ],
)
def test_threads_are_as_many_as_a_container_may_use(lines, files, expected, monkeypatch, tmp_path):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    (tmp_path / "groups").write_text(lines)
    monkeypatch.setattr(groups, "ROOT", tmp_path)
    monkeypatch.setattr(groups, "CONTROL_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(groups, "quota", groups.quota.__wrapped__)
    monkeypatch.setattr(Reading, "now", lambda: None)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    assert FreeCores().count() == given_threads() == expected


@pytest.mark.skipif(Reading.now() is None, reason="the system does not tell how busy its cores are")
def test_work_of_other_programs_is_counted_and_own_work_is_not() -> None:
    seconds = 0.3
    work = f"import time; end = time.process_time() + {seconds}\nwhile time.process_time() < end: pass"
    readings = [Reading.now()]
    run_python(work)
    readings.append(Reading.now())
    exec(work)
    readings.append(Reading.now())
    own = [reading.own for reading in readings if reading]
    cores = [reading.cores for reading in readings if reading]
    assert cores[1] - cores[0] - (own[1] - own[0]) > seconds / 2
    assert own[2] - own[1] >= seconds


def test_torch_has_as_many_threads_as_cores_are_free_in_blocks_with_fewer_too(monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    with torch_threads(2):
        monkeypatch.setattr(FREE_CORES, "count", lambda: 1)
        with on_free_cores():
            assert (torch.get_num_threads(), given_threads()) == (1, 2)
            monkeypatch.setattr(FREE_CORES, "count", lambda: 4)
            with on_free_cores():
                assert torch.get_num_threads() == 2
            with torch_threads(1), on_free_cores():
                assert (torch.get_num_threads(), given_threads()) == (1, 1)
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    assert torch.get_num_threads() == before


def test_a_verb_draws_with_the_threads_it_was_given_and_does_the_rest_with_one(tmp_path, monkeypatch, sample_scene):
    found = dict[str, set[int]](drawing=set(), rest=set())

    class Watching(Kernels):
        name = "watching"

        def run(self, kernel: Kernel, *inputs: Any) -> Any:
            found["drawing"].add(torch.get_num_threads())
            return super().run(kernel, *inputs)

    class Listening(Monitor):
        def say(self, text: str) -> None:
            found["rest"].add(torch.get_num_threads())

    monkeypatch.setattr(FREE_CORES, "count", lambda: 4)
    with torch_threads(2):
        where = {"views": "r_8", "scale": 0.1, "rasterizer": Tiled(Watching()), "monitor": Listening()}
        aaplug.render(sample_scene, SAMPLE, tmp_path / "images", **where)
        assert torch.get_num_threads() == 2
    assert found == {"drawing": {2}, "rest": {1}}


HOLD = """
import os, signal, sys, time
from pathlib import Path
from aaplug.system.executors import Processes
from aaplug.system.locks import scratch
from aaplug.system.signals import end_as_by_interrupt

def hold(item):
    with scratch():
        time.sleep(item)

if __name__ == "__main__":
    for folder in map(Path, sys.argv[1:]):
        if os.fork() == 0:
            os.setsid()
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run where nohup ignores it
            os.environ["TMPDIR"] = str(folder)
            os.dup2(os.open(folder.with_suffix(".err"), os.O_WRONLY | os.O_CREAT), 2)
            end_as_by_interrupt()
            folder.with_suffix(".pid").write_text(str(os.getpid()))
            with scratch():
                list(Processes(1).map(hold, [1000] * 9))
    for _ in sys.argv[1:]:
        os.wait()
"""
HELD = "the program's", "the pool's", "the item's"  # folders of temporary files
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
ENDS = {"SIGTERM": os.kill, "SIGHUP": os.killpg, "SIGKILL": os.kill}  # of a parent alone, and with its group


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_no_worker_outlives_its_program_and_no_temporary_file_one_that_can_answer(tmp_path):
    script, folders = tmp_path / "parent.py", [tmp_path / name for name in ENDS]
    script.write_text(HOLD)
    for folder in folders:
        folder.mkdir()
    with subprocess.Popen([sys.executable, str(script), *map(str, folders)], env=ENVIRONMENT) as starter:
        while starter.poll() is None and not all(len([*f.glob("aaplug-scratch-*")]) == len(HELD) for f in folders):
            time.sleep(0.01)
        parents = [psutil.Process(int(folder.with_suffix(".pid").read_text())) for folder in folders]
        started = [*parents, *chain.from_iterable(parent.children() for parent in parents)]
        try:
            for parent, (name, send) in zip(parents, ENDS.items(), strict=True):
                send(parent.pid, getattr(signal, name))
            assert not psutil.wait_procs(started, timeout=60)[1]
        finally:
            for process in started:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
    *ended, killed = folders
    for folder in ended:
        assert folder.with_suffix(".err").read_text().splitlines()[-1] == "KeyboardInterrupt", folder.name
        assert not [*folder.iterdir()], folder.name
    assert killed.with_suffix(".err").read_text() == ""  # Python's resource tracker warns of what it removes


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="this system has no timer")
def test_a_program_that_ends_does_not_wait_for_its_workers():
    before = signal.signal(signal.SIGALRM, lambda *_: sys.exit(3))
    started = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        with pytest.raises(SystemExit, match="3"):
            list(Processes(1).map(time.sleep, [15]))
    finally:
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - started < 10


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory: you tried ..."),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8 bytes."),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 8 bytes."),
    ],
)
def test_lack_of_memory_is_one_clear_error(error):
    with pytest.raises(UsageError, match="view r_0: out of memory; a smaller `scale`"), within_memory("view r_0"):
        raise error
    with pytest.raises(RuntimeError, match="shape"), within_memory("view r_0"):
        raise RuntimeError("shape '[2]' is invalid for input of size 3")


def test_lack_of_threads_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(Thread, "start", Mock(side_effect=RuntimeError("can't start new thread")))
    with pytest.raises(UsageError, match="threads: the system starts no more; `ulimit -u`"), within_memory("memory"):
        list(Threads(2).map(abs, [1]))


LITTLE_MEMORY = """
import resource
from pathlib import Path
from aaplug import AaplugError, Renderer
from tests.conftest import make_camera, make_scene
renderer = Renderer.of(make_scene(200), [make_camera()], "classic")
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 1_000_000, resource.RLIM_INFINITY))
try:
    renderer(make_camera(size=(6000, 4000)))
except AaplugError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_rendering_without_enough_memory_is_one_clear_error():
    """A process of its own has no memory that earlier tests have freed."""
    assert run_python(LITTLE_MEMORY).stdout.startswith("view view at 6000x4000: out of memory;")


SAME_BITS = """
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import torch
from aaplug.rendering.benchmark import synthetic_camera, synthetic_scene
from aaplug.rendering.renderer import Renderer
from aaplug.system.executors import Processes, Threads

@dataclass
class Draw:
    renderers: list
    views: list
    def __call__(self, item):
        return self.renderers[item % 2](self.views[item // 2]).rgb.numpy().tobytes()

if __name__ == "__main__":
    torch.set_num_threads(2)
    scene, camera = synthetic_scene(1000), synthetic_camera(150, 100)
    renderers = [Renderer.of(scene, [camera], "classic", rasterizer=name).portable() for name in ("eager", "auto")]
    draw = Draw(renderers, [camera, camera.scaled(0.5), camera.scaled(0.25)])
    items = range(6)
    expected = [*map(draw, items)]
    children = []
    for _ in range(2):
        child = os.fork()
        if child == 0:
            os._exit([*map(draw, items)] != expected)
        children.append(child)
    print("forked", [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
    with ThreadPoolExecutor(2) as pool:
        print("threads", [*pool.map(draw, items)] == expected)
    print("pool", [*Threads(2).map(draw, items)] == expected)
    print("processes", [*Processes(1).map(draw, items)] == expected)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_threads_forked_processes_and_pools_draw_the_same_bits_as_one(tmp_path):
    script = tmp_path / "draw.py"
    script.write_text(SAME_BITS)
    words = [sys.executable, str(script)]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.splitlines() == ["forked [0, 0]", "threads True", "pool True", "processes True"], done.stderr


VIEWS = [make_camera((x / 2, -4.0, 0.3), (40, 30), name=f"v{x}") for x in range(4)]
FASTEST = ALL_RASTERIZERS.get("compiled", ALL_RASTERIZERS["eager"])


@pytest.fixture
def renderer() -> Renderer:
    return Renderer.of(make_scene(60), VIEWS, "matched", background=(0.2, 0.3, 0.4), rasterizer=FASTEST)


@pytest.fixture
def paths(tmp_path):
    return [tmp_path / f"{view.name}.png" for view in VIEWS]


def test_files_of_other_processes_are_the_same(renderer, paths, monkeypatch):
    """Of two that are asked for one does the work: a start takes longest."""
    storage = Storage.of(Path("a.npz"), passes=("rgb", "alpha", "depth", "normal", "id"))
    files, progress, paths = [], [], [path.with_suffix(".npz") for path in paths]
    asked = []
    monkeypatch.setattr("aaplug.system.executors.Processes", lambda count: asked.append(count) or Processes(1))
    for threads in (1, 2):
        apply = ProcessesIfLong(threads, pays_after=0.0).map
        how = {"storage": storage, "overwrite": threads == 2, "tell": lambda *now: progress.append(now)}
        write_frames(renderer, VIEWS, paths, apply, **how)
        files.append([path.read_bytes() for path in paths])
    assert asked == [2]
    assert files[0] == files[1]
    assert len(set(files[0])) == len(VIEWS)
    assert progress == 2 * [(done, 4) for done in range(5)]


def test_little_work_starts_no_process(renderer, paths, monkeypatch):
    monkeypatch.setattr("aaplug.system.executors.Processes", None)
    write_frames(renderer, VIEWS, paths, ProcessesIfLong(8).map)
    assert all(path.is_file() for path in paths)
