"""Kills at random moments: nothing is half written, nothing stays behind, and what can be resumed ends the same."""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from aaplug.io.images import read_image
from aaplug.io.scenes import read_scene
from aaplug.system.locks import OUR_PREFIX, SCRATCH_PREFIX
from tests.conftest import SAMPLE
from tests.test_batch import timeless

FASTER = 0.9  # factor on the time within which a job is killed, where it ended before
PROGRAM = "from aaplug_cli.main import main; main()"
SCENE = f"{SAMPLE / 'chair.ply'} --cameras {SAMPLE}"
JOBS = {  # verb, words, and whether --resume continues it
    "convert": (f"convert {SCENE} -o out/c.ply", False),
    "render": (f"render {SCENE} -o out/images --scale 0.5 --views test --threads 2", False),
    "evaluate": (f"evaluate {SCENE} -o out/results --recipe classic --scale 0.25 0.125", True),
    "finetune": (
        f"finetune {SCENE} -o out/t.ply --steps 6 --checkpoint-every 2 --truth self --scale 0.125 --anchor 0",
        True,
    ),
    "video": (f"video {SCENE} -o out/v.webm --scale 0.125 --seconds 0.3 --beside none", False),
}


def start(folder: Path, words: str) -> subprocess.Popen[bytes]:
    """Begin a job in a folder, with temporary files of its own."""
    (folder / "out").mkdir(exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    command = [sys.executable, "-c", PROGRAM, *words.split()]
    quiet = subprocess.DEVNULL
    environment = {**os.environ, "TMPDIR": str(folder / "tmp")}
    return subprocess.Popen(command, cwd=folder, stdout=quiet, stderr=quiet, env=environment)


def content(folder: Path) -> dict[str, object]:
    """Every output, times left out."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    told = timeless(folder)
    return {name: told.get(name, data) for name, data in files.items() if not name.endswith(("jsonl", "finetune.json"))}


def torn(folder: Path) -> list[str]:
    """Outputs that cannot be read."""
    bad = []
    for path in folder.rglob("*"):
        if path.name.startswith(OUR_PREFIX):
            continue
        try:
            if path.suffix == ".ply":
                read_scene(path).gaussians()
            elif path.suffix == ".png":
                read_image(path)
        except Exception as error:
            bad.append(f"{path.name}: {error}")
    return bad


def run(count: int, seed: int) -> tuple[dict[str, int], list[str]]:
    """Kill each job in turn, `count` kills in all; counts, and what went wrong."""
    dice, wrong, counts = random.Random(seed), list[str](), dict[str, int]()
    for job, (words, resumes) in JOBS.items():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            began = time.monotonic()
            assert start(folder, words).wait() == 0
            whole, seconds = content(folder / "out"), time.monotonic() - began
            while counts.get(job, 0) < -(-count // len(JOBS)):
                problem = _one(folder, words, resumes, whole, dice.uniform(0, seconds))
                if problem is None:  # the job is faster than it was
                    seconds *= FASTER
                    continue
                counts[job] = counts.get(job, 0) + 1
                if problem:
                    wrong.append(f"{job}: {problem}")
                    print("  " + wrong[-1], flush=True)
        print(f"  {job}: {counts[job]} kills within {seconds:.1f} s", flush=True)
    return counts, wrong


def _one(folder: Path, words: str, resumes: bool, whole: dict[str, object], moment: float) -> str | None:
    """What went wrong after a kill at that moment, "" for nothing; None if the job had ended before."""
    shutil.rmtree(folder / "out")
    process = start(folder, words)
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment)
        return None
    process.kill()
    process.wait()
    if bad := torn(folder / "out"):
        return f"killed at {moment:.2f} s: {bad}"
    code = start(folder, f"{words} {'--resume' if resumes else '--overwrite'}").wait()
    if code and resumes and start(folder, f"{words} --overwrite").wait() == 0:
        code = 0  # it had ended before it was killed, so that there was nothing to resume
    time.sleep(0.2)  # workers notice the death of their parent
    left = [p.name for p in folder.rglob("*") if p.name.startswith((OUR_PREFIX, SCRATCH_PREFIX))]
    if code or left or content(folder / "out") != whole:
        return f"killed at {moment:.2f} s: exit code {code}, left {left}, same {content(folder / 'out') == whole}"
    return ""
