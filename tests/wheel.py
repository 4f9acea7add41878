"""Check a built wheel: python -m tests.wheel dist/aaplug-*.whl.

It holds every file of the package and no other, and runs from a folder of its own, without the checkout.
"""

import os
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHOWS = """
import aaplug
from pathlib import Path
sample = Path(aaplug.__file__).parent / "io" / "sample"
assert sample.is_relative_to({folder!r}), sample
print(len(aaplug.read_scene(sample / "chair.ply").gaussians()), len(aaplug.read_cameras(sample).test))
"""


def packed(wheel: Path) -> set[str]:
    """The wheel's files, but for its metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def tracked() -> set[str]:
    """The package's files in the repository, as a wheel names them."""
    words = ["git", "ls-files", "aaplug", "cli", "examples/guides/*.md"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    return {re.sub(r"^(cli|examples)/", "aaplug_cli/", name) for name in listed if name}


def run_elsewhere(wheel: Path) -> str:
    """What the wheel prints, installed in a folder of its own: version, a guide's heading, and the sample's sizes."""
    with tempfile.TemporaryDirectory() as folder:
        there = {"cwd": folder, "env": os.environ | {"PYTHONPATH": folder}}
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", folder, str(wheel.resolve())]
        program = [sys.executable, f"{folder}/bin/aaplug"]
        sample = [sys.executable, "-c", SHOWS.format(folder=folder)]
        subprocess.run(pip, check=True)
        said = (
            subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, **there).stdout.splitlines()[0]
            for words in ([*program, "--version"], [*program, "guide", "start"], sample)
        )
        return ", ".join(said)


def main(wheel: Path) -> None:
    """Stop with the first thing that is wrong."""
    missing, foreign = tracked() - packed(wheel), packed(wheel) - tracked()
    if missing or foreign:
        raise SystemExit(
            f"{wheel.name}: lacks {sorted(missing)}, and holds {sorted(foreign)}, which the package does not"
        )
    print(f"{wheel.name}: {len(packed(wheel))} files; {run_elsewhere(wheel)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
