"""What a cluster of this machine's workers costs: the time of a scene, an item and a line of the journal."""

import json
import os
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path

import torch

import aaplug
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.results import Measurement
from aaplug.rendering.benchmark import synthetic_scene
from aaplug.system.cluster import connected
from aaplug.system.executors import WORK_FILE_NAME, load, save
from aaplug.system.monitor import SILENT
from tests.bench import heading, row
from tests.bench.large import cameras, write

MILLION = 1_000_000  # Gaussians
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


def main() -> None:
    """Print what a batch pays besides its views, and what a view costs."""
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
