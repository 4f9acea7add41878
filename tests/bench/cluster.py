"""Clusters of this machine: `python -m tests.bench.cluster same|speed|costs`.

same: kill a worker and the caller at random moments of an evaluation on three workers, resume, and compare the bytes.
speed: the rate of `--scheduler local` against that of plain processes.
costs: what sending a scene, an item and a line of the journal takes.
"""

import argparse
import json
import os
import random
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import psutil
import torch

import aaplug
from aaplug.core.cluster import connected
from aaplug.core.executors import WORK, Executor, Processes, loaded, save
from aaplug.core.monitor import SILENT
from aaplug.evaluation.engine import Task, _Measuring, candidates_of
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.results import Measurement
from aaplug.evaluation.truth import Truth, own_look
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.rendering.benchmark import synthetic_scene
from tests.bench.large import cameras, write
from tests.conftest import SAMPLE
from tests.test_batch import timeless

PROGRAM = "from aaplug_cli.main import program; program()"
LARGE = 1_000_000  # Gaussians
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


def same(kills: int, seed: int) -> None:
    """Kill, resume and compare; the first moments until the workers run are left out."""
    dice, equal = random.Random(seed), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        assert _evaluation(folder / "one").wait() == 0
        seconds, whole = time.monotonic() - began, timeless(folder / "one")
        print(f"one process: {seconds:.1f} s, {len(whole)} files")
        for kill in range(kills):
            out = folder / "out"
            shutil.rmtree(out, ignore_errors=True)
            caller = _evaluation(out, "--scheduler", "local", "--threads", "3")
            views = _killed(caller, out, dice.uniform(0, seconds))
            code = _evaluation(out, "--scheduler", "local", "--threads", "3", "--resume").wait()
            good = code == 0 and timeless(out) == whole
            equal += good
            print(f"{kill + 1}: caller killed with {views} views done: {'same' if good else 'DIFFERENT'}")
    print(f"{equal} of {kills} the same")
    sys.exit(equal != kills)


def _evaluation(output: Path, *words: str) -> subprocess.Popen[bytes]:
    scene = [str(SAMPLE / "chair.ply"), "--cameras", str(SAMPLE), "--views", "test"]
    how = ["--recipe", "classic", "auto", "--scale", "0.25", "0.125", "--layout", "inria"]
    command = [sys.executable, "-c", PROGRAM, "evaluate", *scene, *how, "-o", str(output), *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _killed(caller: subprocess.Popen[bytes], output: Path, seconds: float) -> int:
    """Kill a worker when the first view is done, and the caller so long after; the number of views done."""
    journal = output / "progress.jsonl"
    while not journal.exists() and caller.poll() is None:
        time.sleep(0.01)
    workers = [p for p in psutil.Process(caller.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    workers[0].kill()
    time.sleep(seconds / 3)
    caller.kill()
    caller.wait()
    return max(0, len(journal.read_bytes().splitlines()) - 1)


def speed(workers: int, views: int, runs: int) -> None:
    """Rates of both pools, by turns: with start and end, without, and per second of processor time with both."""
    work, pools = _measuring(views), {"processes": _processes, "--scheduler local": _local}
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in pools}
    for _ in range(runs):
        for name, pool in pools.items():
            began, used = time.monotonic(), _processor_time()
            with pool(workers) as executor:
                ends = [time.monotonic() for _ in executor.map(work, range(views))]
            total = time.monotonic() - began
            found[name].append((views / total, (views - 1) / (ends[-1] - ends[0]), views / (_processor_time() - used)))
            print(f"{name}: {total:.1f} s; views a second:", *(f"{rate:.2f}" for rate in found[name][-1]), flush=True)
    medians = {
        name: [statistics.median(column) for column in zip(*rates, strict=True)] for name, rates in found.items()
    }
    for name, rates in medians.items():
        print(f"{name}:", *(f"{rate:.3f}" for rate in rates))
    ratios = [b / a for a, b in zip(*medians.values(), strict=True)]
    print("ratio:", *(f"{ratio:.2f}" for ratio in ratios))


def _processor_time() -> float:
    """Seconds of this process and those that it has seen end."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in spent)


@contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    yield Processes(workers)


def _local(workers: int) -> AbstractContextManager[Executor]:
    return connected("local", workers, None, SILENT)


def _measuring(views: int) -> Callable[[int], object]:
    """The sample's evaluation at five scales."""
    scene, known = read_scene(SAMPLE / "chair.ply"), read_cameras(SAMPLE)
    shown = known.train[:views]
    renderer = aaplug.Renderer.of(scene, known, "auto", rasterizer="eager")
    candidates = candidates_of(scene, renderer.training, [renderer.recipe], "eager")
    return _Measuring(Task(candidates, SCALES, shown, Truth(own_look(scene, renderer.training))), None)


def costs() -> None:
    """What a batch pays besides its views, and what a view costs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _sending(folder)
        _journal(folder)
        _scene_and_view(folder)
    for workers in (1, 3):
        with connected("local", workers, None, SILENT) as cluster:
            list(cluster.map(os.path.basename, ["a"] * 10))
            began = time.monotonic()
            list(cluster.map(os.path.basename, ["a"] * 1000))
            print(f"items, {workers} workers: {time.monotonic() - began:.2f} ms each")


def _sending(folder: Path) -> None:
    """A scene's way to a worker: the file, written once, and its first reading."""
    scene = synthetic_scene(LARGE)
    began = time.monotonic()
    save(partial(_touched, scene), folder / WORK)
    written = time.monotonic()
    loaded(folder / WORK)(0)
    read, size = time.monotonic() - written, (folder / WORK).stat().st_size / 1e6
    print(f"{LARGE:,} Gaussians, {size:.0f} MB: {written - began:.2f} s to write, {read:.2f} s to read")


def _journal(folder: Path) -> None:
    """A line of the journal, with five recipes at five scales."""
    times, line = [], [Measurement("auto", s, "v", {"PSNR": 30.0, "SSIM": 0.9}, 4, 0.1, "", 1) for s in SCALES * 5]
    with Journal(folder / "j" / "progress.jsonl", {}, resume=False) as journal:
        for view in range(200):
            began = time.monotonic()
            journal.add(view, line)
            times.append(time.monotonic() - began)
        size = journal.path.stat().st_size / len(times)
    print(f"journal: {1000 * statistics.median(times):.2f} ms a view, {size:.0f} bytes")


def _scene_and_view(folder: Path) -> None:
    """Seconds that a scene of a million Gaussians takes once, and for each of its views of 800x800 px."""
    write(str(folder / "scene.ply"), LARGE)
    (folder / "cameras.json").write_text(json.dumps(cameras()))
    how = {"recipe": "auto", "scale": SCALES, "rasterizer": "eager", "threads": 1}
    seconds = []
    for views in ("v0", "v0,v1,v2,v3"):
        began = time.monotonic()
        aaplug.evaluate(folder / "scene.ply", folder / "cameras.json", views=views, **how)
        seconds.append(time.monotonic() - began)
    view = (seconds[1] - seconds[0]) / 3
    print(f"{LARGE:,} Gaussians at five scales: {seconds[0] - view:.1f} s once, {view:.1f} s a view")


def _touched(scene: aaplug.Gaussians, _: int) -> float:
    """Read all of a scene."""
    return float(sum(value.double().sum() for value in vars(scene).values() if isinstance(value, torch.Tensor)))


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["same", "speed", "costs"])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--runs", type=int, default=3)
    o = parser.parse_args()
    if o.what == "same":
        same(o.kills, o.seed)
    elif o.what == "speed":
        speed(o.workers, o.views, o.runs)
    else:
        costs()


if __name__ == "__main__":
    main()
