"""Kill a batch at random moments, resume it, and compare it with an uninterrupted one: `python -m tests.bench.resume`.

Every result and image must be the same byte for byte, except for times.
"""

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.conftest import SAMPLE
from tests.test_batch import timeless

SETTINGS = f"""
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
PROGRAM = "from aaplug_cli.main import main; main()"


def start(folder: Path, *flags: str) -> subprocess.Popen[bytes]:
    """Begin the batch."""
    words = ["evaluate", "--batch", str(folder / "batch.toml"), "-o", str(folder / "out"), *flags]
    quiet = subprocess.DEVNULL
    return subprocess.Popen([sys.executable, "-c", PROGRAM, *words], stdout=quiet, stderr=quiet)


def main() -> None:
    """Kill as often as asked for, and print when and with what outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    dice, same = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "batch.toml").write_text(SETTINGS)
        began = time.monotonic()
        assert start(folder).wait() == 0
        whole, seconds = timeless(folder / "out"), time.monotonic() - began
        print(f"uninterrupted: {seconds:.1f} s, {len(whole)} files")
        for kill in range(options.kills):
            shutil.rmtree(folder / "out", ignore_errors=True)
            moment = dice.uniform(0, seconds)
            process = start(folder)
            time.sleep(moment)
            process.kill()
            process.wait()
            done = sum(len(p.read_bytes().splitlines()) - 1 for p in folder.rglob("*.jsonl"))
            code = start(folder, "--resume").wait()
            equal = code == 0 and timeless(folder / "out") == whole
            same += equal
            outcome = "same" if equal else "DIFFERENT"
            print(f"kill {kill + 1} at {moment:.1f} s, {done} views done: {outcome}")
    print(f"{same} of {options.kills} the same")
    sys.exit(same != options.kills)


if __name__ == "__main__":
    main()
