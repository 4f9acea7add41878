"""Kills at random moments: nothing is half written, nothing stays behind, and what can be resumed ends the same.

`batch` is killed and resumed as one command.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from aaplug.io.images import read_image
from aaplug.io.scenes import read_scene
from aaplug.system.locks import OUR_PREFIX, SCRATCH_PREFIX
from tests.bench import heading, row
from tests.conftest import SAMPLE
from tests.test_batch import timeless

SOONER = 0.9  # factor on the time within which a job is killed, where it ended before
PROGRAM = "from aaplug_cli.main import main; main()"
SCENE = f"{SAMPLE / 'chair.ply'} --cameras {SAMPLE}"
EVALUATION = f"evaluate {SCENE} -o out/results --scale 0.25 0.125 --recipe classic"
BATCH = f"""
cameras = "{SAMPLE}"
recipe = ["classic", "auto"]
scale = [0.25, 0.125]
layout = "inria"
[[scene]]
name = "one"
scene = "{SAMPLE / "chair.ply"}"
[[scene]]
name = "two"
scene = "{SAMPLE / "chair.ply"}"
quality = "fast"
"""


class Job(NamedTuple):
    """A command to kill.  again: the word of the run that follows."""

    words: str
    again: str = "--overwrite"


JOBS = {
    "convert": Job(f"convert {SCENE} -o out/c.ply"),
    "render": Job(f"render {SCENE} -o out/images --scale 0.5 --views test --threads 2"),
    "evaluate": Job(EVALUATION, "--resume"),
    "finetune": Job(
        f"finetune {SCENE} -o out/t.ply --steps 6 --checkpoint-every 2 --truth self --scale 0.125 --anchor 0",
        "--resume",
    ),
    "video": Job(f"video {SCENE} -o out/v.webm --scale 0.125 --seconds 0.3 --beside none"),
    "batch": Job("evaluate --batch batch.toml -o out/many", "--resume"),
}


def main(kills: int = 40, jobs: Sequence[str] = tuple(JOBS), seed: int = 0) -> None:
    """Kill each job so often; print a row for it, and end with 1 if anything went wrong.

    seed: of the moments.
    """
    dice, wrong = random.Random(seed), 0
    heading("kills", "job", "kills", "within, s", "wrong")
    for name in jobs:
        with tempfile.TemporaryDirectory() as folder:
            problems, seconds = _killed(Path(folder), JOBS[name], kills, dice)
        wrong += len(problems)
        row(name, kills, f"{seconds:.1f}", "; ".join(problems) or 0)
    sys.exit(wrong > 0)


def start(folder: Path, words: str) -> subprocess.Popen[bytes]:
    """Begin a job in a folder, with temporary files of its own."""
    (folder / "out").mkdir(exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    (folder / "batch.toml").write_text(BATCH)
    command = [sys.executable, "-c", PROGRAM, *words.split()]
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
    return subprocess.Popen(command, cwd=folder, stdout=quiet, stderr=quiet, env=environment)


def _killed(folder: Path, job: Job, count: int, dice: random.Random) -> tuple[list[str], float]:
    """What went wrong in so many kills, and the time within which the last one was, in s."""
    began = time.monotonic()
    assert start(folder, job.words).wait() == 0
    whole, seconds, problems = _content(folder / "out"), time.monotonic() - began, list[str]()
    done = 0
    while done < count:
        problem = _problem(folder, job, whole, dice.uniform(0, seconds))
        if problem is None:  # the job is faster than it was
            seconds *= SOONER
            continue
        done += 1
        problems += [problem] if problem else []
    return problems, seconds


def _problem(folder: Path, job: Job, whole: dict[str, object], moment: float) -> str | None:
    """What went wrong after a kill at that moment, "" for nothing; None if the job had ended before."""
    shutil.rmtree(folder / "out")
    process = start(folder, job.words)
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment)
        return None
    process.kill()
    process.wait()
    if torn := _torn(folder / "out"):
        return f"killed at {moment:.2f} s: {torn}"
    code = start(folder, f"{job.words} {job.again}").wait()
    if code and job.again == "--resume" and start(folder, f"{job.words} --overwrite").wait() == 0:
        code = 0  # it had ended before it was killed, so that there was nothing to resume
    time.sleep(0.2)  # workers notice the death of their parent
    left = [p.name for p in folder.rglob("*") if p.name.startswith((OUR_PREFIX, SCRATCH_PREFIX))]
    same = _content(folder / "out") == whole
    return f"killed at {moment:.2f} s: exit code {code}, left {left}, same {same}" if code or left or not same else ""


def _content(folder: Path) -> dict[str, object]:
    """Every output, times left out."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    told = timeless(folder)
    return {name: told.get(name, data) for name, data in files.items() if not name.endswith(("jsonl", "finetune.json"))}


def _torn(folder: Path) -> list[str]:
    """Outputs that cannot be read."""
    problems = []
    for path in folder.rglob("*"):
        read = {".ply": read_scene, ".png": read_image}.get(path.suffix)
        if read is None or path.name.startswith(OUR_PREFIX):
            continue
        try:
            read(path)
        except Exception as error:
            problems.append(f"{path.name}: {error}")
    return problems
