"""Peak memory and time of commands on a large scene: python -m tests.bench.large [GAUSSIANS [FOLDER]].

A synthetic scene of degree 3, 248 bytes a Gaussian, is written part by part and deleted at the end.  Two views see a
part of it each, and training cameras around and inside see most of it.  Each command runs in a process of its own.
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

from aaplug.core.cameras import look_at
from aaplug.core.gaussians import Gaussians
from aaplug.io.scenes import write_parts
from aaplug.rendering.benchmark import synthetic_scene

PART = 1_000_000  # Gaussians made at once
SIZE = 800  # px
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
GB = 1e9


def parts(count: int) -> Iterator[Gaussians]:
    """Scenes on the same surfaces, each as fine as all of them together."""
    for seed, start in enumerate(range(0, count, PART)):
        part = synthetic_scene(min(PART, count - start), seed)
        yield replace(part, log_scales=part.log_scales - 0.5 * math.log(count / len(part)))


def write(path: str, count: int) -> None:
    """Write the scene."""
    write_parts(path, parts(count), count)


def cameras() -> list[dict[str, Any]]:
    """Two views, a ring of training cameras around the ball, and one that looks outwards."""
    found = [_entry(0, (3.6, -3.0, 1.6), (0, 0, -0.1), 50.0), _entry(1, (0.0, 2.2, 0.5), (0, 0, -0.2), 40.0)]
    for i in range(8):
        x, y = math.cos(math.tau * i / 8), math.sin(math.tau * i / 8)
        found.append(_entry(len(found), (4 * x, 4 * y, 1.5), (0, 0, -0.1), 70.0))
        if i % 2:
            found.append(_entry(len(found), (0.1 * x, 0.1 * y, 1.2), (5 * x, 5 * y, 3), 100.0))
    return found


def _entry(number: int, eye: tuple[float, ...], target: tuple[float, ...], degrees: float) -> dict[str, Any]:
    """An entry of INRIA's cameras.json."""
    pose = look_at(torch.tensor(eye).double(), torch.tensor(target).double(), UP)
    rotation = pose[:3, :3].T
    focal = SIZE / 2 / math.tan(math.radians(degrees) / 2)
    names = {"id": number, "img_name": f"v{number}", "width": SIZE, "height": SIZE, "fx": focal, "fy": focal}
    return names | {"position": (-rotation @ pose[:3, 3]).tolist(), "rotation": rotation.tolist()}


def measured(command: str, *args: str) -> str:
    """A row of the table; the command's own words go to stderr."""
    started = time.perf_counter()
    child = subprocess.Popen(["aaplug", command, *args], stdout=sys.stderr)
    _, status, used = os.wait4(child.pid, 0)
    seconds, processor = time.perf_counter() - started, used.ru_utime + used.ru_stime
    code = os.waitstatus_to_exitcode(status)
    if code:
        raise SystemExit(f"{command} ended with {code}")
    unit = 1 if sys.platform == "darwin" else 1024  # bytes of ru_maxrss
    return f"| `{command}` | {used.ru_maxrss * unit / GB:.2f} | {seconds:.0f} | {processor:.0f} |"


def main(count: int = 20_000_000, folder: str | None = None) -> None:
    """Make the scene, run the commands, print the table."""
    with tempfile.TemporaryDirectory(dir=folder) as made:
        scene, views, out = (str(Path(made) / name) for name in ("scene.ply", "cameras.json", "out"))
        maker = multiprocessing.get_context("spawn").Process(target=write, args=(scene, count))
        maker.start()  # a child's peak begins with its parent's memory, which must stay small
        maker.join()
        Path(views).write_text(json.dumps(cameras()))
        print(f"{count:,} Gaussians, {Path(scene).stat().st_size / GB:.2f} GB\n", flush=True)
        print("| command | peak memory, GB | s | s of processor |\n|---|---|---|---|", flush=True)
        same = (scene, "--cameras", views)
        print(measured("info", *same), flush=True)
        print(measured("convert", *same, "-o", out + ".ply"), flush=True)
        print(measured("render", *same, "-o", out, "--views", "v0,v1", "--resolution", f"{SIZE}x{SIZE}"), flush=True)


if __name__ == "__main__":
    main(int(float([*sys.argv, "20e6"][1])), *sys.argv[2:3])
