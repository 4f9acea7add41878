"""What a cluster of this machine's workers costs: rates, and the time of a scene, an item and a line of the journal."""

import json
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Literal

import torch

import aaplug
from aaplug.evaluation.engine import Task, ViewMeasurer, candidates_of
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.results import Measurement
from aaplug.evaluation.truth import Truth
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.rendering.benchmark import synthetic_scene
from aaplug.rendering.renderer import own_look
from aaplug.system.cluster import connected
from aaplug.system.executors import WORK_FILE_NAME, Executor, Processes, load, save
from aaplug.system.monitor import SILENT
from tests.bench import heading, row
from tests.bench.large import cameras, write
from tests.conftest import SAMPLE

MILLION = 1_000_000  # Gaussians
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


def main(what: Literal["speed", "costs"], workers: int = 2, views: int = 24, runs: int = 3) -> None:
    """Print a table.

    Args:
        what: speed: views a second of `--scheduler local` against plain processes.  costs: what a batch pays besides
            its views, and what a view costs.
        workers: of speed.
        views: of speed.
        runs: of speed, of which medians are printed.
    """
    speed(workers, views, runs) if what == "speed" else costs()


def speed(workers: int, views: int, runs: int) -> None:
    """Views a second of both pools, by turns: with start and end, without, and by processor time with both."""
    scene, data = read_scene(SAMPLE / "chair.ply"), read_cameras(SAMPLE)
    renderer = aaplug.Renderer.of(scene, data, "auto", rasterizer="eager")
    candidates = candidates_of(scene, renderer.training, [renderer.recipe], "eager")
    work = ViewMeasurer(Task(candidates, SCALES, data.train[:views], Truth(own_look(scene, renderer.training))), None)
    pools = {"processes": _processes, "--scheduler local": lambda count: connected("local", count, None, SILENT)}
    rates: dict[str, list[tuple[float, ...]]] = {name: [] for name in pools}
    heading("views a second", "", "with start and end", "without", "of processor time")
    for _ in range(runs):
        for name, pool in pools.items():
            began, used = time.monotonic(), _processor_time()
            with pool(workers) as executor:
                ends = [time.monotonic() for _ in executor.map(work, range(views))]
            total = time.monotonic() - began
            rates[name].append((views / total, (views - 1) / (ends[-1] - ends[0]), views / (_processor_time() - used)))
            row(name, *rates[name][-1])
    medians = [[statistics.median(column) for column in zip(*each, strict=True)] for each in rates.values()]
    for name, values in zip(rates, medians, strict=True):
        row(f"{name}, medians", *values)
    row("ratio", *(local / plain for plain, local in zip(*medians, strict=True)))


def _processor_time() -> float:
    """Seconds of this process and those that it has seen end."""
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in spent)


@contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    yield Processes(workers)


def costs() -> None:
    """What a batch pays besides its views, and what a view costs."""
    heading("costs", "what", "measured")
    with tempfile.TemporaryDirectory() as name:
        _sending(Path(name))
        _journal(Path(name))
        _scene_and_view(Path(name))
    for workers in (1, 3):
        with connected("local", workers, None, SILENT) as cluster:
            list(cluster.map(os.path.basename, ["a"] * 10))
            began = time.monotonic()
            list(cluster.map(os.path.basename, ["a"] * 1000))
            row(f"items, {workers} workers", f"{time.monotonic() - began:.2f} ms each")


def _sending(folder: Path) -> None:
    """A scene's way to a worker: the file, written once, and its first reading."""
    scene = synthetic_scene(MILLION)
    began = time.monotonic()
    save(partial(_touched, scene), folder / WORK_FILE_NAME)
    written = time.monotonic()
    load(folder / WORK_FILE_NAME)(0)
    seconds, size = time.monotonic() - written, (folder / WORK_FILE_NAME).stat().st_size / 1e6
    row(f"{MILLION:,} Gaussians, {size:.0f} MB", f"{written - began:.2f} s to write, {seconds:.2f} s to read")


def _touched(scene: aaplug.Gaussians, _: int) -> float:
    """Read all of a scene."""
    return float(sum(value.double().sum() for value in vars(scene).values() if isinstance(value, torch.Tensor)))


def _journal(folder: Path) -> None:
    """A line of the journal, with five recipes at five scales."""
    times, line = [], [Measurement("auto", s, "v", {"PSNR": 30.0, "SSIM": 0.9}, 4, 0.1, "", 1) for s in SCALES * 5]
    with Journal(folder / "j" / "progress.jsonl", {}, resume=False) as journal:
        for view in range(200):
            began = time.monotonic()
            journal.add(view, line)
            times.append(time.monotonic() - began)
        assert journal.path is not None
        size = journal.path.stat().st_size / len(times)
    row("journal", f"{1000 * statistics.median(times):.2f} ms a view, {size:.0f} bytes")


def _scene_and_view(folder: Path) -> None:
    """Seconds that a scene of a million Gaussians takes once, and for each of its views of 800x800 px."""
    write(str(folder / "scene.ply"), MILLION)
    (folder / "cameras.json").write_text(json.dumps(cameras()))
    options = {"recipe": "auto", "scale": SCALES, "rasterizer": "eager", "threads": 1}
    seconds = []
    for views in ("v0", "v0,v1,v2,v3"):
        began = time.monotonic()
        aaplug.evaluate(folder / "scene.ply", folder / "cameras.json", views=views, **options)
        seconds.append(time.monotonic() - began)
    view = (seconds[1] - seconds[0]) / 3
    row(f"{MILLION:,} Gaussians at five scales", f"{seconds[0] - view:.1f} s once, {view:.1f} s a view")
