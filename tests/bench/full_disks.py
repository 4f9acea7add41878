"""Every writer with room for a few bytes only: one line of error, and nothing half written."""

import resource
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from tests.bench import heading, row
from tests.bench.kills import JOBS, PROGRAM, SCENE

ROOM = (0, 1000, 100_000)  # bytes a file may have
WRITERS = {
    **{name: JOBS[name].words for name in ("convert", "render", "evaluate", "finetune", "video")},
    "report": f"evaluate {SCENE} -o out/results --recipe classic --scale 0.25 --report",
    "inria layout": f"evaluate {SCENE} -o out/results --recipe classic --scale 0.25 --layout inria",
    "spz": f"convert {SCENE} -o out/c.spz",
    "splat": f"convert {SCENE} -o out/c.splat",
    "mp4": f"video {SCENE} -o out/v.mp4 --scale 0.125 --seconds 0.3",
    "demo": "demo -o out/demo",
}


def main() -> None:
    """Run every writer with every room; print what went wrong, and end with 1 if anything did."""
    heading("full disks", "writer", *(f"{room:,} bytes" for room in ROOM))
    wrong = 0
    for name, words in WRITERS.items():
        problems = [_problem(words, room) for room in ROOM]
        wrong += len(list(filter(None, problems)))
        row(name, *(problem or "right" for problem in problems))
    sys.exit(wrong > 0)


def _problem(words: str, room: int) -> str:
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        out.mkdir()
        command = [sys.executable, "-c", PROGRAM, *words.split()]
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (room, room))
        done = subprocess.run(command, cwd=name, capture_output=True, text=True, check=False, preexec_fn=limit)
        large = [p.name for p in out.rglob("*") if p.is_file() and p.stat().st_size > room]
        hidden = [p.name for p in out.rglob(".*")]
    said = done.stderr.splitlines()
    refused = done.returncode == 2 and said[-1].startswith("error: ") and "Traceback" not in done.stderr
    right = (done.returncode == 0 or refused) and not hidden and not large
    return "" if right else f"exit code {done.returncode}, hidden {hidden}, too large {large}, {said[-1:]}"
