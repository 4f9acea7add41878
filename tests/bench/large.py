"""Peak memory and time of commands on a large scene, each in a process of its own.

A synthetic scene of degree 3, 248 bytes a Gaussian, is written part by part and deleted at the end.  Two views see a
part of it each, and training cameras around and inside see most of it.
"""

import json
import math
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from aaplug import Gaussians, look_at
from aaplug.io.scenes import write_parts
from aaplug.rendering.benchmark import synthetic_scene
from tests.bench import heading, row

PART_GAUSSIANS = 1_000_000  # made at once
SIDE = 800  # px
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
GB = 1e9
MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes


def main(gaussians: float = 20e6, folder: Path | None = None) -> None:
    """Make the scene in a temporary folder inside this one, run the commands, and print the table."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        scene, views, out = (str(Path(scratch) / name) for name in ("scene.ply", "cameras.json", "out"))
        maker = multiprocessing.get_context("spawn").Process(target=write, args=(scene, int(gaussians)))
        maker.start()  # a child's peak begins with its parent's memory, which must stay small
        maker.join()
        Path(views).write_text(json.dumps(cameras()))
        title = f"{int(gaussians):,} Gaussians, {Path(scene).stat().st_size / GB:.2f} GB"
        heading(title, "command", "peak memory, GB", "s", "s of processor")
        inputs = (scene, "--cameras", views)
        _measure("info", *inputs)
        _measure("convert", *inputs, "-o", out + ".ply")
        _measure("render", *inputs, "-o", out, "--views", "v0,v1", "--resolution", f"{SIDE}x{SIDE}")


def write(path: str, count: int) -> None:
    """Write scenes on the same surfaces as one, each as fine as all of them together."""

    def parts() -> Iterator[Gaussians]:
        for seed, start in enumerate(range(0, count, PART_GAUSSIANS)):
            part = synthetic_scene(min(PART_GAUSSIANS, count - start), seed)
            yield replace(part, log_scales=part.log_scales - 0.5 * math.log(count / len(part)))

    write_parts(path, parts(), count)


def cameras() -> list[dict[str, Any]]:
    """Two views, a ring of training cameras around the ball, and four that look outwards."""
    places = [((3.6, -3.0, 1.6), (0.0, 0.0, -0.1), 50.0), ((0.0, 2.2, 0.5), (0.0, 0.0, -0.2), 40.0)]
    for i in range(8):
        x, y = math.cos(math.tau * i / 8), math.sin(math.tau * i / 8)
        places.append(((4 * x, 4 * y, 1.5), (0.0, 0.0, -0.1), 70.0))
        if i % 2:
            places.append(((0.1 * x, 0.1 * y, 1.2), (5 * x, 5 * y, 3.0), 100.0))
    entries = []  # of INRIA's cameras.json
    for number, (eye, target, degrees) in enumerate(places):
        rotation = look_at(torch.tensor(eye).double(), torch.tensor(target).double(), UP)[:3, :3].T
        focal = SIDE / 2 / math.tan(math.radians(degrees) / 2)
        names = {"id": number, "img_name": f"v{number}", "width": SIDE, "height": SIDE, "fx": focal, "fy": focal}
        entries.append(names | {"position": list(eye), "rotation": rotation.tolist()})
    return entries


def _measure(command: str, *args: str) -> None:
    """Print a row of the table; the command's own words go to stderr."""
    started = time.perf_counter()
    child = subprocess.Popen(["aaplug", command, *args], stdout=sys.stderr)
    _, status, used = os.wait4(child.pid, 0)
    seconds, processor = time.perf_counter() - started, used.ru_utime + used.ru_stime
    if code := os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{command} ended with {code}")
    row(f"`{command}`", used.ru_maxrss * MAXRSS_UNIT / GB, round(seconds), round(processor))
