"""A frame, a command and a program beside a busy process: milliseconds and ratios, quiet and busy, by thread policy.

The neighbour has a session of its own, as programs of other users have: Linux shares the cores between sessions first.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from tempfile import TemporaryDirectory

import torch

from aaplug.system.cores import WINDOW_SECONDS
from tests.bench import heading, row, timed
from tests.bench.scenes import CHECKPOINTS, trained
from tests.conftest import SHARED_DATA

SPIN = "while True: pass"
PROGRAM = """
import aaplug
from tests.conftest import SAMPLE
scene, cameras = aaplug.read_scene(SAMPLE / "chair.ply"), aaplug.read_cameras(SAMPLE)
aaplug.evaluate(scene, cameras, scale=[0.5, 0.25], recipe=["auto"])
aaplug.convert(scene, cameras, "{folder}/chair.sog", overwrite=True)
"""
ENVIRONMENTS = ("", "OMP_WAIT_POLICY=passive", "GOMP_SPINCOUNT=1000", "GOMP_SPINCOUNT=10000")


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """`count` processes of normal priority, each of which keeps one core busy."""
    others = [subprocess.Popen([sys.executable, "-c", SPIN], start_new_session=True) for _ in range(count)]
    time.sleep(2 * WINDOW_SECONDS)
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    """Median time of `work`, after one call that is not counted."""
    return 1e3 * timed({"": work}, repeats)[""]


@torch.no_grad()
def frames(repeats: int) -> None:
    """Print the milliseconds of a frame of the chair with all threads and with one."""
    scene = trained("chair")
    renderer, view = scene.renderer("classic"), scene.views()[0]
    times = [milliseconds(lambda: renderer(view), repeats)]
    torch.set_num_threads(1)
    print(*times, milliseconds(lambda: renderer(view), repeats))


def frames_within(environment: str, repeats: int) -> list[float]:
    """What `frames` prints in a process with one more variable."""
    command = [sys.executable, "-m", "tests.bench", "busy", "--frame", "--repeats", str(repeats)]
    variables = os.environ | dict(word.split("=") for word in environment.split())
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=variables)
    return [float(word) for word in run.stdout.split()]


def main(repeats: int = 5, frame: bool = False) -> None:
    """Print two tables: the chair at 800x800 by environment; `aaplug render` of its 25 views at 1/4, and a program.

    frame: print only this process's times of a frame.
    """
    if frame:
        frames(repeats)
        return
    heading(
        "the chair, 800x800, `classic`, ms", "environment", "quiet", "quiet, one thread", "busy", "busy / quiet one"
    )
    for environment in ENVIRONMENTS:
        quiet, single = frames_within(environment, repeats)
        with neighbours(1):
            busy = frames_within(environment, repeats)[0]
        row(f"`{environment or 'as it is'}`", quiet, single, busy, busy / single)
    with TemporaryDirectory() as folder:
        words = f"aaplug render {SHARED_DATA / CHECKPOINTS['chair'].file} --scale 0.25 --overwrite -o {folder}/out"
        program = [sys.executable, "-c", PROGRAM.format(folder=folder)]
        heading("ms", "what", "quiet", "busy", "busy / quiet")
        for what, command in (("`aaplug render`", words.split()), ("evaluates and converts the sample", program)):
            run = partial(subprocess.run, command, check=True, capture_output=True)
            quiet = milliseconds(run, repeats)
            with neighbours(1):
                busy = milliseconds(run, repeats)
            row(what, quiet, busy, busy / quiet)
