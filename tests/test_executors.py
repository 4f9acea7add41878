"""Worker pools: results in order, few items read ahead, errors that come back whole, no worker outlives its parent."""

import math
import os
import platform
import subprocess
import sys
from itertools import count

import psutil
import pytest
import torch

from aaplug.system.cores import FREE_CORES, FreeCores, Reading, on_free_cores
from aaplug.system.errors import FormatError, UsageError
from aaplug.system.executors import Processes, Threads, torch_threads

PARENT = """
import time
from aaplug.system.executors import Processes
if __name__ == "__main__":
    for _ in Processes(1).map(time.sleep, [0, 1000]):
        print("working", flush=True)
"""


FULL = """
import resource
from functools import partial
import torch
from aaplug.system.errors import OutputError
from aaplug.system.executors import Processes
if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    try:
        list(Processes(1).map(partial(torch.add, torch.zeros(10**6)), [1]))
    except OutputError as error:
        print(error)
"""


def refuse_three(item: int) -> int:
    if item == 3:
        raise FormatError("scene.ply", "is short")
    return item * item


@pytest.mark.parametrize("executor", [Threads(2), Processes(2)], ids=lambda executor: type(executor).__name__)
def test_results_come_in_order_until_the_first_error(executor):
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


def test_a_worker_ends_when_its_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, str(script)], **streams) as parent:
        assert parent.stdout is not None
        assert parent.stderr is not None
        assert parent.stdout.readline() == b"working\n"
        workers = psutil.Process(parent.pid).children()
        parent.kill()
        gone, alive = psutil.wait_procs(workers, timeout=30)
        assert parent.stderr.read() == b""  # Python's resource tracker warns of what it removes
    assert gone
    assert not alive


def test_a_disk_that_is_full_is_named(tmp_path):
    script = tmp_path / "full.py"
    script.write_text(FULL)
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    process = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, timeout=60)
    assert process.stdout.endswith("work.pt: cannot be written: file too large\n")
    assert list(tmp_path.iterdir()) == [script]


def test_torch_threads_are_given_back():
    before = torch.get_num_threads()
    with torch_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before


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
    kept, usual = (
        int(subprocess.run([sys.executable, "-c", script, how], capture_output=True, text=True, check=True).stdout)
        for how in ("kept", "usual")
    )
    assert kept < usual / 10


def test_threads_leave_a_core_to_another_program(monkeypatch: pytest.MonkeyPatch) -> None:
    # Two cores and one second: this process worked 0.5 s of each, another program the rest of one core.
    readings = iter([Reading(0.0, 0.0, 0.0), Reading(1.0, 1.0, 2.0), Reading(2.0, 2.0, 3.0), Reading(3.0, 2.5, 3.7)])
    monkeypatch.setattr(Reading, "now", lambda: next(readings))
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 1}, raising=False)
    monkeypatch.setattr("aaplug.system.cores.WINDOW_SECONDS", -math.inf)
    cores = FreeCores()
    assert [cores.count() for _ in range(3)] == [1, 2, 2]


@pytest.mark.skipif(Reading.now() is None, reason="the system does not tell how busy its cores are")
def test_work_of_other_programs_is_counted_and_own_work_is_not() -> None:
    seconds = 0.3
    work = f"import time; end = time.process_time() + {seconds}\nwhile time.process_time() < end: pass"
    readings = [Reading.now()]
    subprocess.run([sys.executable, "-c", work], check=True)
    readings.append(Reading.now())
    exec(work)
    readings.append(Reading.now())
    own = [reading.own for reading in readings if reading]
    cores = [reading.cores for reading in readings if reading]
    assert cores[1] - cores[0] - (own[1] - own[0]) > seconds / 2
    assert own[2] - own[1] >= seconds


def test_torch_has_as_many_threads_as_cores_are_free_and_then_its_own_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FREE_CORES, "count", lambda: 1)
    with torch_threads(2):
        with on_free_cores():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
