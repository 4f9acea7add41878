"""Every option of every verb with odd values, generated from the options themselves."""

import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from aaplug_cli.main import main as program  # pyright: ignore[reportMissingImports]
from aaplug_cli.verbs import VERBS  # pyright: ignore[reportMissingImports]

from tests.bench import heading, row
from tests.conftest import make_dataset

ODD = ("nan", "inf", "-inf", "-1", "0", str(10**30), "", "x" * 10_000, os.fsdecode(b"\xff\xfe\x80"))
EXIT_CODES = ("0", "1", "2", "130")
SECONDS = 120  # of the clock, for one run
MEMORY = 6 * 2**30  # bytes of address space
BASE = {  # what makes each verb do a little work
    "info": "scene.ply --cameras .",
    "convert": "scene.ply --cameras . -o c.ply",
    "lod": "scene.ply --cameras . -o l.ply --simplify 0.5",
    "render": "scene.ply --cameras . -o images --rasterizer eager",
    "evaluate": "scene.ply --cameras . -o results --recipe classic --scale 0.5 --rasterizer eager",
    "video": "scene.ply --cameras . -o v.webm --seconds 0.1 --rasterizer eager",
    "finetune": "scene.ply --cameras . -o t.ply --steps 1 --truth self --scale 0.5 --rasterizer eager",
    "demo": "-o demo.txt/x",
    "bench": "--gaussians 100 --resolution 32x32 --repeats 1 --rasterizer eager",
}
SKIPPED = ("warmup",)  # it has no values, and compiles for minutes


def main(processes: int = os.cpu_count() or 1) -> None:
    """Run all cases, so many at a time; print counts by exit code, and end with 1 if anything went wrong."""
    counts, named = Counter[str](), list(cases())
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(processes) as pool:
        data = make_dataset(Path(folder))
        for (name, _), result in zip(named, pool.map(lambda case: outcome(case[1], data), named), strict=True):
            counts[result if result in EXIT_CODES else "wrong"] += 1
            if result not in EXIT_CODES:
                print(f"{name}: {result}".encode(errors="backslashreplace").decode()[:400], flush=True)
    heading("odd options", "runs", *(f"exit code {code}" for code in EXIT_CODES), "wrong")
    row(len(named), *(counts[code] for code in (*EXIT_CODES, "wrong")))
    sys.exit(counts["wrong"] > 0)


def cases() -> Iterator[tuple[str, list[str]]]:
    """A name and the words of each run."""
    for verb in VERBS:
        if verb in SKIPPED:
            continue
        for option in VERBS[verb].options:
            for value in ODD:
                words = [verb, *BASE.get(verb, "").split()]
                if option in ("scene", "more"):
                    words.append(value)
                else:
                    words += [f"--{option.replace('_', '-')}", value]
                yield f"{verb} --{option} {value[:12]!r}", words


def outcome(words: list[str], data: Path) -> str:
    """Run the program in a child; its exit code, or what went wrong."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(data, folder, dirs_exist_ok=True)
        (folder / "demo.txt").touch()
        child = multiprocessing.get_context("fork").Process(target=_run, args=(words, folder))
        child.start()
        child.join(SECONDS)
        if child.is_alive():
            child.kill()
            return "endless"
        said = (folder / "stderr").read_text(errors="backslashreplace").splitlines()
        code = child.exitcode
    if str(code) not in EXIT_CODES:
        return f"exit code {code}: {said[-1:]}"
    if any("Traceback" in line for line in said):
        return f"traceback: {said[-1]}"
    errors = [line for line in said if line.startswith("error: ")]
    if code == 2 and not (len(errors) == 1 and said[-1] == errors[0]):
        return f"refused in {len(errors)} lines: {said[-2:]}"
    return str(code)


def _run(words: list[str], folder: Path) -> None:
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    for stream, descriptor in (("stdout", 1), ("stderr", 2)):
        os.dup2(os.open(stream, os.O_WRONLY | os.O_CREAT), descriptor)
    code = 0
    try:
        program(words)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:  # what would be a traceback
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # a fork of a thread cannot end in another way
