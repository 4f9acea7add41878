"""Whether this tree makes what another revision made: `python -m tests.bench.same_as 0db394d --keep FOLDER`.

Both checkouts are driven by their command lines alone, because the Python API changes between them: the same renders,
conversions, evaluations and fine-tunings, one thread a command.  What they write is decoded and compared value by
value; seconds, versions and plots are left out.  A difference fails the bench unless `EXPECTED` gives a reason for it,
and so does a command that fails in both.  A JSON text of several words is prose: a new wording is noted, not counted.

`--keep` stores what the base makes, so that the next run makes only what is not there yet.
"""

import argparse
import csv
import io
import json
import os
import platform
import queue
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from plyfile import PlyData
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = REPOSITORY.parent / "shared" / "data"
THREADS = 1  # a command: sums are taken in one order, and commands run side by side
PACKAGES = ("torch", "numpy", "opencv-contrib-python-headless", "scikit-image")

# Old names and new ones.  A checkout whose --help tells the new name of an option is given that.
RATE_REFERENCE = {"--rate": "--rate-reference"}
CULL_MARGIN = {"--guard": "--cull-margin"}
METRIC = {  # 0.2 names all metrics: these are the usual ones and what is asked for
    "--flicker": "--metric psnr ssim consistency energy-drift flicker",
    "--ssim": "--metric psnr consistency energy-drift",
    "3dgs": "ssim:3dgs",
}
VIEWER_NAMES = {"classic-viewer": "classic", "antialiased-viewer": "antialiased", "mip-viewer": "mip"}
OPTIONS: Mapping[str, Mapping[str, str]] = {
    "render": CULL_MARGIN | RATE_REFERENCE,
    "evaluate": CULL_MARGIN | RATE_REFERENCE | METRIC,
    "convert": CULL_MARGIN | VIEWER_NAMES,
    "finetune": CULL_MARGIN | VIEWER_NAMES | {"--rate": "--learning-rate"},
}
KEYS = {"pairs": "evaluations", "guard": "cull_margin", "rate": "rate_reference"}  # in JSON and CSV
TIMES_AND_VERSIONS = ("seconds", "versions", "platform")  # keys of JSON and CSV
NOT_COMPARED = ("*.jsonl", "*.html", "plots/*")  # journals, pages and plots, which show seconds

OWN_BOUNDS = "the tuned scene is measured with its own sampling bounds, not those of the scene before (a trap of 0.1)"
MORE_FACTS = "the one evaluation engine states the protocol in these reports too"
# Places that may differ, as "CASE/FILE#PLACE", and why: what 0.2 mends.
EXPECTED: Mapping[str, str] = {
    "finetune-densify/*": "0.1 fails with an IndexError: it keeps the sampling bounds of the scene before it grew",
    "finetune-*/*.json#/after@*": OWN_BOUNDS,
    "finetune-*/*.png#pixels": OWN_BOUNDS,
    "finetune-*/*.json#*/_aaplug/*": MORE_FACTS,
    "convert-for-*/*.json#*/_aaplug/*": MORE_FACTS,
}
SSIM_ROUNDING = 1e-14  # SSIM is scikit-image's in 0.2, which adds in another order

RECIPES = (  # of 0db394d, but for multi-scale, which needs columns that no scene here has, and what is gone
    *("classic", "ewa", "mip"),
    *("mip-splatting", "mip-splatting-code", "mip-splatting-balanced", "mip-splatting-anisotropic"),
    *("aaa", "analytic", "sa-gs", "sa-gs-integral", "sa-gs-samples"),
    *("matched", "matched-interval", "matched-sharpest", "matched-samples"),
    *("matched-integral", "2dgs", "2dgs-matched", "aa-2dgs"),
    "auto",
)
COMPILED = ("classic", "matched", "auto", "matched-integral")
VIEWERS = ("classic-viewer", "antialiased-viewer", "mip-viewer", "gsplat")
CHAIR_SCALES = (0.125, 0.25, 0.5, 1.0, 2.0)
SNOWMIKU_SCALES = (0.125, 0.25)
TWO_VIEWS_UP_TO = 0.5  # scale; one view above
QUICK_SCALES = (0.125, 0.5)  # what --quick renders of the chair

INPUTS = "../inputs"  # as a command sees them from its own folder
CHAIR = f"{INPUTS}/chair/chair.ply --cameras {INPUTS}/chair"
SNOWMIKU = f"{INPUTS}/snowmiku/snowmiku.ply --cameras {INPUTS}/snowmiku --guard 0.3"
SNOWMIKU_VIEW = "20240212_003919"
DRAWN = f"--threads {THREADS} --rasterizer"

PROGRAM = """
import json, os, sys
import aaplug
from aaplug_cli.main import main

print(os.path.realpath(aaplug.__file__), flush=True)
for line in sys.stdin:
    words, folder, printed, log = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        for path, mode, stream in ((os.devnull, "rb", 0), (printed, "wb", 1), (log, "wb", 2)):
            with open(path, mode) as opened:
                os.dup2(opened.fileno(), stream)
        sys.argv[1:] = words
        main()
        sys.exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""  # imports torch once, and starts a process for every command that it is told to run


@dataclass(frozen=True)
class Case:
    """One command, in the words of 0db394d, and the row of the table that it belongs to."""

    slug: str
    row: str
    words: tuple[str, ...]
    quick: bool = False


@dataclass(frozen=True)
class Outcome:
    """How a command ended; `seconds` is 0 where it was kept from an earlier run."""

    code: int
    last: str
    seconds: float


@dataclass(frozen=True)
class Side:
    """One of the two checkouts, and the folder that everything it makes goes to."""

    name: str
    checkout: Path
    folder: Path
    kept: bool  # whether what an earlier run made is taken


@dataclass(frozen=True)
class Difference:
    """Where two outputs differ; `size` is the largest absolute difference of numbers."""

    place: str
    what: str
    size: float = 0.0
    prose: bool = False


class Prose(str):
    """Words for people, which may change."""


# The commands


def all_cases(compiled: bool) -> list[Case]:
    """Every command, those that take longest first."""
    cases = [*finetunings(), *conversions(), *evaluations(), *renders()]
    return cases + [case for case in compiled_renders() if compiled]


def a_case(row: str, rest: str, words: str, quick: bool = False) -> Case:
    """A case whose folder is named by its row and the rest."""
    slug = "-".join(f"{row} {rest}".split())
    return Case(slug, row, tuple(words.split()), quick)


def renders() -> Iterator[Case]:
    """Every recipe at every scale, and what options change."""
    for recipe in RECIPES:
        for scale in CHAIR_SCALES:
            yield a_render("chair", recipe, scale, "eager", scale in QUICK_SCALES)
        for scale in SNOWMIKU_SCALES:
            yield a_render("snowmiku", recipe, scale, "eager")
    extra = {
        "auto-fast": "--recipe auto --quality fast --scale 0.125",
        "auto-best": "--recipe auto --quality best --scale 0.25",
        "matched-to-sharpest": "--recipe matched --rate sharpest --scale 0.25",
        "matched-to-interval": "--recipe matched --rate interval --scale 0.25",
        "8-bits": "--recipe auto --resolution -1x150 --background black",
    }
    for name, words in extra.items():
        command = f"render {CHAIR} -o images --views r_24 {DRAWN} eager {words}"
        yield a_case("render options", name, command, quick=True)


def a_render(scene: str, recipe: str, scale: float, kernels: str, quick: bool = False) -> Case:
    """One recipe at one scale, 16 bits a channel."""
    views = "r_8,r_136" if scale <= TWO_VIEWS_UP_TO else "r_8"
    source = f"{CHAIR} --views {views}"
    if scene == "snowmiku":
        source = f"{SNOWMIKU} --views {SNOWMIKU_VIEW}"
    how = f"--recipe {recipe} --scale {scale:g} --bit-depth 16 {DRAWN} {kernels}"
    row = f"render {scene} {recipe}" if kernels == "eager" else f"{kernels} {scene} {recipe}"
    return a_case(row, f"{scale:g}", f"render {source} -o images {how}", quick)


def compiled_renders() -> Iterator[Case]:
    """Those that are asked for by --compiled."""
    for recipe in COMPILED:
        for scale in CHAIR_SCALES:
            yield a_render("chair", recipe, scale, "compiled", scale in QUICK_SCALES)


def conversions() -> Iterator[Case]:
    """Closed forms, and a short fit for one viewer."""
    plain = f"convert {CHAIR} --json -o"
    yield a_case("convert", "plain", f"{plain} out.ply", quick=True)
    yield a_case("convert", "mip-splatting", f"{plain} out.ply --form mip-splatting", quick=True)
    yield a_case("convert", "variance", f"{plain} out.ply --variance 0.1", quick=True)
    yield a_case("convert", "splat", f"{plain} out.splat", quick=True)
    yield a_case("convert", "snowmiku", f"convert {SNOWMIKU} --json -o out.ply")
    fitted = f"{plain} out.ply --views r_0,r_50 {DRAWN} eager"
    for viewer in VIEWERS:
        words = f"{fitted} --for {viewer} --steps 0"
        yield a_case("convert for", viewer, words, quick=viewer == "mip-viewer")
    yield a_case("convert for", "5-steps", f"{fitted} --for antialiased-viewer --steps 5")


def evaluations() -> Iterator[Case]:
    """Metrics by several protocols, truths and layouts."""
    chair = f"evaluate {CHAIR} -o out {DRAWN} eager"
    two = "--views r_8,r_136"
    flicker = f"{two} --recipe classic matched auto --scale 0.5 0.125 --flicker --report"
    layout = f"{two} --recipe ewa mip-splatting aaa matched-integral --scale 1 0.25 --layout inria"
    own = f"{two} --recipe matched mip --scale 2 0.25 --truth self --rate sharpest"
    yield a_case("evaluate", "flicker", f"{chair} {flicker}")
    yield a_case("evaluate", "layout", f"{chair} {layout} --ssim 3dgs")
    yield a_case("evaluate", "self", f"{chair} {own}")
    for protocol in ("distance", "fov"):
        words = f"{chair} --views r_8 --protocol {protocol} --recipe matched classic"
        yield a_case("evaluate", protocol, words)
    small = "--views r_24,r_88 --recipe classic auto --scale 0.5 0.125"
    yield a_case("evaluate", "small", f"{chair} {small}", quick=True)
    snowmiku = f"evaluate {SNOWMIKU} -o out {DRAWN} eager --views {SNOWMIKU_VIEW}"
    yield a_case("evaluate", "snowmiku", f"{snowmiku} --recipe classic auto --scale 0.25 0.125")


def finetunings() -> Iterator[Case]:
    """Few steps of every kind."""
    chair = f"finetune {CHAIR} -o out.ply --truth self --views r_8 {DRAWN} eager"
    densify = "--steps 12 --densify-every 5 --scale 0.25 0.125"
    viewer = "--steps 6 --for mip-viewer --loss l1-dssim --rate 0.5 --seed 3 --scale 0.25"
    yield a_case("finetune", "plain", f"{chair} --steps 20 --scale 0.25 0.125")
    yield a_case("finetune", "densify", f"{chair} {densify}")
    yield a_case("finetune", "viewer", f"{chair} {viewer}")
    yield a_case("finetune", "mipmap-gs", f"{chair} --steps 5 --method mipmap-gs --scale 0.25")
    yield a_case("finetune", "short", f"{chair} --steps 3 --scale 0.125", quick=True)


# Running them


class Driver:
    """A process that has a checkout's program imported and runs commands of it, one after another."""

    def __init__(self, checkout: Path, links: Path) -> None:
        threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        environment = os.environ | dict.fromkeys(threads, str(THREADS))
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM],
            env=environment | {"PYTHONPATH": str(links), "COLUMNS": "120"},
            cwd=links,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        told = self._told()
        if not Path(told).is_relative_to(checkout.resolve()):
            raise SystemExit(f"{checkout}: another aaplug was imported: {told}")

    def run(self, words: Sequence[str], folder: Path, printed: Path, log: Path) -> int:
        """Run a command in a folder; its exit code."""
        assert self.process.stdin is not None
        order = [list(words), *(str(path.resolve()) for path in (folder, printed, log))]
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        return int(self._told())

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()

    def _told(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        if not line:
            raise SystemExit("a checkout's program does not start, or died; its words are above")
        return line


def make(side: Side, cases: Sequence[Case], jobs: int) -> dict[str, Outcome]:
    """Run what is not there yet, `jobs` commands side by side; outcomes by case."""
    outcomes = {case.slug: found for case in cases if (found := kept(side, case)) is not None}
    missing = [case for case in cases if case.slug not in outcomes]
    if not missing:
        return outcomes
    drivers: queue.Queue[Driver] = queue.Queue()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        links = Path(name)
        (links / "aaplug").symlink_to(side.checkout.resolve() / "aaplug")
        (links / "aaplug_cli").symlink_to(side.checkout.resolve() / "cli")
        started = [Driver(side.checkout, links) for _ in range(jobs)]
        for driver in started:
            stack.callback(driver.close)
            drivers.put(driver)
        spoken = spoken_by(started[0], links, {case.words[0] for case in missing})
        pool = stack.enter_context(ThreadPoolExecutor(jobs))

        def run(case: Case) -> Outcome:
            taken = drivers.get()
            try:
                return made(side, case, taken, spoken(case.words))
            finally:
                drivers.put(taken)

        done = track(pool.map(run, missing), side.name, len(missing), console=Console(stderr=True))
        return outcomes | dict(zip((case.slug for case in missing), done, strict=True))


def made(side: Side, case: Case, driver: Driver, words: Sequence[str]) -> Outcome:
    """Run one command into an empty folder, and note how it ended."""
    folder, log, told = (side.folder / f"{case.slug}{kind}" for kind in ("", ".log", ".json"))
    told.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    printed = folder / "printed.json" if "--json" in words else Path(os.devnull)
    began = time.monotonic()
    code = driver.run(words, folder, printed, log)
    lines = log.read_text(errors="replace").strip().splitlines()
    outcome = Outcome(code, lines[-1] if lines else "", time.monotonic() - began)
    told.write_text(json.dumps({"key": key(case), **vars(outcome)}, indent=1))
    return outcome


def kept(side: Side, case: Case) -> Outcome | None:
    """How the same command ended in an earlier run."""
    note = side.folder / f"{case.slug}.json"
    if not (side.kept and note.is_file()):
        return None
    data = json.loads(note.read_text())
    whole = data["code"] >= 0 and data["key"] == key(case)  # below 0 it was killed
    return Outcome(data["code"], data["last"], 0.0) if whole else None


def key(case: Case) -> list[str]:
    """What an outcome depends on, beside the checkout and the data."""
    packages = [f"{name} {version(name)}" for name in PACKAGES]
    processor = torch.backends.cpu.get_cpu_capability()
    return [*case.words, *packages, platform.python_version(), platform.machine(), processor]


def spoken_by(driver: Driver, folder: Path, verbs: Iterable[str]) -> Callable[[Sequence[str]], list[str]]:
    """A function that puts a command in the words that a checkout's --help has."""
    names: dict[str, Mapping[str, str]] = {}
    for verb in verbs:
        told = folder / f"{verb}.txt"
        driver.run([verb, "--help"], folder, told, folder / f"{verb}.log")
        known = told.read_text().replace(",", " ").split()
        renamed = any(old.startswith("--") and old not in known for old in OPTIONS[verb])
        names[verb] = OPTIONS[verb] if renamed else {}
    return lambda words: [part for word in words for part in names[words[0]].get(word, word).split()]


# Comparing what they made


def differences(case: Case, base: Side, new: Side) -> list[Difference]:
    """Every place where the outputs of a case differ."""
    found = []
    for file in files_of(case, base, new):
        paths = [side.folder / case.slug / file for side in (base, new)]
        present = [path.is_file() for path in paths]
        if not all(present):
            found.append(Difference(file, f"only in the {'base' if present[0] else 'new'}"))
            continue
        before, after = (decoded(path) for path in paths)
        for place in dict.fromkeys([*before, *after]):
            difference = apart(f"{file}#{place}", before, after, place)
            if difference is not None:
                found.append(difference)
    return found


def files_of(case: Case, *sides: Side) -> list[str]:
    """The files that any side made, by their place in its folder."""
    folders = [side.folder / case.slug for side in sides]
    files = {path.relative_to(folder).as_posix() for folder in folders for path in folder.rglob("*") if path.is_file()}
    return sorted(f for f in files if not any(fnmatch(f, f"*{left}") for left in NOT_COMPARED))


def decoded(path: Path) -> dict[str, Any]:
    """A file's content: values by place."""
    if path.suffix == ".png":
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert pixels is not None, path
        return {"pixels": pixels}
    if path.suffix == ".ply":
        return decoded_ply(path)
    if path.suffix == ".json":
        return dict(leaves(json.loads(path.read_text())))
    if path.suffix == ".csv":
        rows = csv.DictReader(io.StringIO(path.read_text()))
        return dict(leaves([{k: number(v) for k, v in row.items()} for row in rows]))
    return {"bytes": np.frombuffer(path.read_bytes(), dtype=np.uint8)}


def number(text: str) -> float | str:
    """A cell of a table."""
    try:
        return float(text)
    except ValueError:
        return text


def decoded_ply(path: Path) -> dict[str, Any]:
    """A .ply's header and columns."""
    ply = PlyData.read(str(path))
    columns = {
        f"{element.name}/{name}": np.asarray(element.data[name])
        for element in ply.elements
        for name in element.data.dtype.names or ()
    }
    return {"header": str(ply.header)} | columns


def leaves(data: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested data by their place, under today's names."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            if name not in TIMES_AND_VERSIONS:
                yield from leaves(value, f"{place}/{KEYS.get(name, name)}")
    elif isinstance(data, list):
        for index, value in enumerate(data):
            yield from leaves(value, f"{place}/{index}")
    else:
        yield place, Prose(data) if isinstance(data, str) and " " in data else data


def apart(place: str, before: Mapping[str, Any], after: Mapping[str, Any], name: str) -> Difference | None:
    """How two contents differ at a place; None if they are equal to the bit."""
    if name not in before or name not in after:
        value, where = (after[name], "new") if name in after else (before[name], "base")
        return Difference(place, f"only in the {where}", prose=isinstance(value, Prose))
    a, b = before[name], after[name]
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return arrays_apart(place, a, b)
    if type(a) is type(b) and a == b:
        return None
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        size = abs(float(a) - float(b))
        return Difference(place, f"{a} is {b}", size) if size != 0 else None
    if isinstance(a, str) and isinstance(b, str):
        prose = isinstance(a, Prose) and isinstance(b, Prose)
        return Difference(place, texts_apart(a, b), prose=prose)
    return Difference(place, f"{a} is {b}")


def texts_apart(a: str, b: str) -> str:
    """The lines that are not in both."""
    before, after = a.splitlines(), b.splitlines()
    gone = [line for line in before if line not in after]
    come = [line for line in after if line not in before]
    return f"{'; '.join(gone) or 'nothing'} is {'; '.join(come) or 'nothing'}"


def arrays_apart(place: str, a: np.ndarray, b: np.ndarray) -> Difference | None:
    """How two arrays differ; equal numbers of other bits, such as -0, count too."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return Difference(place, f"{a.dtype} {a.shape} is {b.dtype} {b.shape}")
    if a.tobytes() == b.tobytes():
        return None
    apart = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return Difference(place, f"{np.count_nonzero(apart)} of {a.size} values", float(np.nanmax(apart)))


# Telling


@dataclass(frozen=True)
class Finding:
    """What is said of a case."""

    verdict: str
    files: int
    size: float = 0.0
    note: str = ""


SAME, EXPECTEDLY, DIFFERS, FAILS = "same", "expected", "differs", "fails in both"
COLOURS = {SAME: "green", EXPECTEDLY: "cyan", DIFFERS: "red", FAILS: "red"}  # from good to bad
WIDTH = 160  # of the table where there is no terminal
NOTED = 2  # differences that a note names


def judged(case: Case, base: Side, new: Side, before: Outcome, after: Outcome) -> Finding:
    """Compare a case."""
    files = len(files_of(case, base, new))
    if before.code == after.code != 0 and before.last == after.last:
        known = reason(case, Difference("exit code", ""))
        return Finding(FAILS if known is None else SAME, files, note=f"fails: {before.last}")
    if before.code == after.code == 0 and not files:
        return Finding(FAILS, files, note=f"{case.slug}: neither made anything")
    found = differences(case, base, new)
    if before.code != after.code or before.code != 0:
        what = "; ".join(
            f"{name} ends with {outcome.code}" + (f": {outcome.last}" if outcome.code else "")
            for name, outcome in (("the base", before), ("the new", after))
        )
        found.insert(0, Difference("exit code", what))
    size = max((difference.size for difference in found), default=0.0)
    counted = [difference for difference in found if not difference.prose]
    unexplained = [difference for difference in counted if reason(case, difference) is None]
    if unexplained:
        return Finding(DIFFERS, files, size, f"{case.slug}: {listed(unexplained)}")
    if counted:
        reasons = dict.fromkeys(reason(case, difference) or "" for difference in counted)
        return Finding(EXPECTEDLY, files, size, "; ".join(reasons))
    reworded = f"{len(found)} texts reworded" if found else ""
    return Finding(SAME, files, note=reworded)


def reason(case: Case, difference: Difference) -> str | None:
    """Why a difference is as it should be, if it is."""
    place = f"{case.slug}/{difference.place}"
    if "/SSIM" in place and 0 < difference.size <= SSIM_ROUNDING:
        return f"SSIM is scikit-image's, within {SSIM_ROUNDING:g}"
    return next((why for pattern, why in EXPECTED.items() if fnmatch(place, pattern)), None)


def listed(found: Sequence[Difference]) -> str:
    """Some differences, those that are no numbers first, then the largest; and how many more."""
    first = sorted(found, key=lambda difference: (difference.size > 0, -difference.size))[:NOTED]
    told = [f"{difference.place}: {difference.what}" for difference in first]
    more = len(found) - len(told)
    return "; ".join(told + [f"{more} more"] * (more > 0))


def tabled(cases: Sequence[Case], findings: Sequence[Finding]) -> Table:
    """A line a row: the worst verdict of its cases."""
    table = Table()
    for column in ("what", "commands", "files", "verdict", "largest difference", "note"):
        table.add_column(column, overflow="fold")
    rows: dict[str, list[Finding]] = {}
    for case, finding in zip(cases, findings, strict=True):
        rows.setdefault(case.row, []).append(finding)
    order = list(COLOURS)
    for row, group in rows.items():
        worst = max((finding.verdict for finding in group), key=order.index)
        size = max(finding.size for finding in group)
        table.add_row(
            row,
            str(len(group)),
            str(sum(finding.files for finding in group)),
            f"[{COLOURS[worst]}]{worst}[/]",
            f"{size:.3g}" if size else "",
            escape("\n".join(dict.fromkeys(f.note for f in group if f.note))),
        )
    return table


# The whole


def main() -> None:
    """Make both, compare, print, and exit with 1 if anything differs that should not."""
    options = arguments()
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="same-as-")))
        commit = git("rev-parse", "--short", options.revision).decode().strip()
        checkout = options.base or unpacked(commit, work / "checkout")
        check_revision(checkout, commit)
        keep = options.keep or work
        base = Side("base", checkout, keep / commit, options.keep is not None)
        new = Side("new", options.new, keep / "new", False)
        cases = chosen(options)
        outcomes = []
        for side in (base, new):
            link_inputs(side, checkout, options.data)
            began = time.monotonic()
            outcomes.append(make(side, cases, options.jobs))
            print(timed(side, outcomes[-1], time.monotonic() - began), file=sys.stderr)
        findings = [judged(case, base, new, *(of[case.slug] for of in outcomes)) for case in cases]
    wide = None if sys.stdout.isatty() else WIDTH
    Console(width=wide).print(tabled(cases, findings))
    verdicts = [finding.verdict for finding in findings]
    print(", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in COLOURS))
    sys.exit(DIFFERS in verdicts or FAILS in verdicts)


def arguments() -> argparse.Namespace:
    """What the user asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("revision", help="what to compare with")
    parser.add_argument("--base", type=Path, help="a checkout of it (default: git archive)")
    parser.add_argument("--new", type=Path, default=REPOSITORY, help="default: this tree")
    parser.add_argument("--data", type=Path, default=DATA, help="the folder that holds snowmiku")
    parser.add_argument("--keep", type=Path, help="keep what is made there; for one run at a time")
    parser.add_argument("--quick", action="store_true", help="a few of the commands")
    parser.add_argument("--compiled", action="store_true", help="the kernels of warmup too")
    parser.add_argument("--only", default="*", help="cases by pattern, such as 'convert*'")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="side by side")
    return parser.parse_args()


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the user asks for and the data allows."""
    cases = all_cases(options.compiled)
    if not (options.data / "snowmiku").is_dir():
        print(f"no snowmiku in {options.data}: left out", file=sys.stderr)
        cases = [case for case in cases if "snowmiku" not in case.slug]
    return [c for c in cases if (c.quick or not options.quick) and fnmatch(c.slug, options.only)]


def link_inputs(side: Side, checkout: Path, data: Path) -> None:
    """The same scenes for both: the base's sample, and the data."""
    inputs = side.folder / "inputs"
    shutil.rmtree(inputs, ignore_errors=True)
    inputs.mkdir(parents=True)
    (inputs / "chair").symlink_to(checkout.resolve() / "aaplug" / "sample")
    (inputs / "snowmiku").symlink_to(data.resolve() / "snowmiku")


def unpacked(commit: str, folder: Path) -> Path:
    """A checkout of a commit."""
    with tarfile.open(fileobj=io.BytesIO(git("archive", commit))) as archive:
        archive.extractall(folder, filter="data")
    return folder


def check_revision(checkout: Path, commit: str) -> None:
    """Refuse a base that is a checkout of another commit."""
    if (checkout / ".git").exists():
        head = git("rev-parse", "HEAD", folder=checkout).decode()
        if not head.startswith(commit):
            raise SystemExit(f"{checkout} is at {head.strip()}, not at {commit}")


def git(*words: str, folder: Path = REPOSITORY) -> bytes:
    """What git prints."""
    return subprocess.run(["git", "-C", str(folder), *words], check=True, capture_output=True).stdout


def timed(side: Side, outcomes: Mapping[str, Outcome], wall: float) -> str:
    """How long a side took."""
    fresh = {slug: outcome.seconds for slug, outcome in outcomes.items() if outcome.seconds}
    slowest = sorted(fresh, key=lambda slug: -fresh[slug])[:3]
    told = ", ".join(f"{slug} {fresh[slug]:.0f} s" for slug in slowest)
    return f"{side.name}: {wall:.0f} s, {len(fresh)} commands of {len(outcomes)} run; {told}"


if __name__ == "__main__":
    main()
