"""Every writer with room for a few bytes only: one line of error, and nothing half written."""

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.bench.campaign.kills import JOBS, PROGRAM, SCENE

ROOM = (0, 1000, 100_000)  # bytes a file may have
WRITERS = {
    **{name: words for name, (words, _) in JOBS.items()},
    "report": f"evaluate {SCENE} -o out/results --recipe classic --scale 0.25 --report",
    "inria layout": f"evaluate {SCENE} -o out/results --recipe classic --scale 0.25 --layout inria",
    "spz": f"convert {SCENE} -o out/c.spz",
    "splat": f"convert {SCENE} -o out/c.splat",
    "mp4": f"video {SCENE} -o out/v.mp4 --scale 0.125 --seconds 0.3",
    "demo": "demo -o out/demo",
}


def run() -> tuple[int, list[str]]:
    """Run every writer with every room; how many runs there were, and what went wrong."""
    wrong = []
    for name, words in WRITERS.items():
        for room in ROOM:
            if problem := _one(words, room):
                wrong.append(f"{name} with {room} bytes: {problem}")
                print("  " + wrong[-1][:300], flush=True)
    return len(WRITERS) * len(ROOM), wrong


def _one(words: str, room: int) -> str:
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        out.mkdir()
        command = [sys.executable, "-c", PROGRAM, *words.split()]
        done = subprocess.run(command, cwd=name, capture_output=True, text=True, check=False, preexec_fn=_limit(room))
        said = done.stderr.splitlines()
        left = [p.name for p in out.rglob("*") if p.is_file() and p.stat().st_size > room]
        hidden = [p.name for p in out.rglob(".*")]
    whole = done.returncode == 0
    refused = done.returncode == 2 and said[-1].startswith("error: ") and "Traceback" not in done.stderr
    return "" if (whole or refused) and not hidden and not left else f"{done.returncode}, {hidden}, {left}, {said[-1:]}"


def _limit(room: int):
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
