"""Kills at random moments: nothing is half written, nothing stays behind, and what can be resumed ends the same.

Every second kill is -9; the others are TERM and HUP in turn, after which nothing may stay behind even before the next
run.  `batch` is killed and resumed as one command.  Of `cluster` a worker is killed too; its bytes are those of one
process.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil

from aaplug import read_image, read_scene
from aaplug.system.locks import OUR_PREFIX, SCRATCH_PREFIX
from tests.bench import heading, row
from tests.conftest import SAMPLE
from tests.test_batch import timeless

SOONER = 0.9  # factor on the time within which a job is killed, where it ended before
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP)
PROGRAM = "from aaplug_cli.main import program; program()"
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
    """A command to kill.

    workers: further words of the runs that are killed and that follow, whose journal tells that workers are at work.
    again: the word of the run that follows.
    """

    words: str
    again: str = "--overwrite"
    workers: str = ""


JOBS = {
    "convert": Job(f"convert {SCENE} -o out/c.ply"),
    "render": Job(f"render {SCENE} -o out/images --scale 0.5 --views test --threads 2"),
    "evaluate": Job(EVALUATION, "--resume"),
    "finetune": Job(
        f"finetune {SCENE} -o out/t.ply --steps 6 --checkpoint-every 2 --truth self --scale 0.125 --anchor 0",
        "--resume",
    ),
    "lod": Job(f"lod {SCENE} -o out/levels --levels 2 --no-refine"),
    "video": Job(f"video {SCENE} -o out/v.webm --scale 0.125 --seconds 0.3 --beside none"),
    "sequence": Job(f"video {SCENE} -o out/f/frame.####.png --scale 0.125 --seconds 0.3 --threads 2", "--resume"),
    "batch": Job("evaluate --batch batch.toml -o out/many", "--resume"),
    "cluster": Job(f"{EVALUATION} auto --layout inria --views test", "--resume", "--scheduler local --threads 3"),
}


class Outcome(NamedTuple):
    """What went wrong after a kill: outputs half written, files left behind, results that differ; in words."""

    torn: str = ""
    left: str = ""
    other: str = ""


def main(kills: int = 20, jobs: Sequence[str] = tuple(JOBS), seed: int = 0) -> None:
    """Kill each job so often; print a row for it, and end with 1 if anything went wrong.

    seed: of the moments.
    """
    dice, wrong = random.Random(seed), list[str]()
    heading("kills", "job", "kills", "by TERM or HUP", "within, s", "torn", "left behind", "other results")
    for name in jobs:
        with tempfile.TemporaryDirectory() as folder:
            outcomes, seconds = _killed(Path(folder), JOBS[name], kills, dice)
        counts = [sum(map(bool, column)) for column in zip(*outcomes, strict=True)]
        row(name, kills, sum(SIGNALS[i % 4] != signal.SIGKILL for i in range(kills)), f"{seconds:.1f}", *counts)
        wrong += [f"{name}: {problem}" for outcome in outcomes for problem in outcome if problem]
    print("\n".join(["", *wrong]))
    sys.exit(bool(wrong))


def start(folder: Path, words: str) -> subprocess.Popen[bytes]:
    """Begin a job in a folder, with temporary files of its own."""
    (folder / "out").mkdir(exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    (folder / "batch.toml").write_text(BATCH)
    command = [sys.executable, "-c", PROGRAM, *words.split()]
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
    return subprocess.Popen(command, cwd=folder, stdout=quiet, stderr=quiet, env=environment)


def _killed(folder: Path, job: Job, count: int, dice: random.Random) -> tuple[list[Outcome], float]:
    """The outcomes of so many kills, and the time within which the last one was, in s."""
    began = time.monotonic()
    assert start(folder, job.words).wait() == 0
    whole, seconds, outcomes = _content(folder / "out"), time.monotonic() - began, list[Outcome]()
    while len(outcomes) < count:
        outcome = _outcome(folder, job, whole, dice.uniform(0, seconds), SIGNALS[len(outcomes) % 4])
        if outcome is None:  # the job is faster than it was
            seconds *= SOONER
        else:
            outcomes.append(outcome)
    return outcomes, seconds


def _outcome(folder: Path, job: Job, whole: dict[str, object], moment: float, kill: signal.Signals) -> Outcome | None:
    """The outcome of a kill at that moment; None if the job had ended before."""
    shutil.rmtree(folder / "out")
    words, where = f"{job.words} {job.workers}", f"{kill.name} at {moment:.2f} s: "
    process = start(folder, words)
    if job.workers:
        _kill_a_worker(process, folder / "out" / "results" / "progress.jsonl")
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment)
        return None
    process.send_signal(kill)
    process.wait()
    torn, left = _torn(folder / "out"), [] if kill == signal.SIGKILL else _left(folder)
    code = start(folder, f"{words} {job.again}").wait()
    if code and job.again == "--resume" and start(folder, f"{words} --overwrite").wait() == 0:
        code = 0  # it had ended before it was killed, so that there was nothing to resume
    time.sleep(0.2)  # workers notice the death of their parent
    left += _left(folder)
    same = _content(folder / "out") == whole
    return Outcome(
        f"{where}{torn}" if torn else "",
        f"{where}{left}" if left else "",
        f"{where}exit code {code}, same {same}" if code or not same else "",
    )


def _left(folder: Path) -> list[str]:
    """Temporary files, in their folder and beside the outputs."""
    beside = [path for path in (folder / "out").rglob("*") if path.name.startswith((OUR_PREFIX, SCRATCH_PREFIX))]
    return [str(path.relative_to(folder)) for path in [*(folder / "tmp").iterdir(), *beside]]


def _kill_a_worker(process: subprocess.Popen[bytes], journal: Path) -> None:
    """Kill one of a command's workers as soon as a view is done."""
    while not journal.exists() and process.poll() is None:
        time.sleep(0.01)
    with suppress(psutil.Error):
        children = psutil.Process(process.pid).children(recursive=True)
        next(child for child in children if "spawn_main" in " ".join(child.cmdline())).kill()


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
