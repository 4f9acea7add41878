"""Many scenes in one evaluation: which they are, and what becomes of those that fail.

A scene that fails stops no other; it is listed at the end, and the exit code says so.
"""

import difflib
import json
import re
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.table import Table

from aaplug.core.errors import AaplugError, FormatError, UsageError
from aaplug.evaluation.results import Report, as_csv, method, results, scale_name
from aaplug.io.atomic import replacing
from aaplug.io.batch_file import read_batch

from .console import escape, log, out, print_json, say
from aaplug.io.folders import make_folder, refuse_existing
from .options import CONFIG

if TYPE_CHECKING:
    from .evaluate import Evaluate

FAILED = 1  # exit code
FILES = ("batch.json", "results.csv")
NOT_IN_A_FILE = ("batch", "more", "json", "resume", "overwrite")
ONCE = ("output", "threads", "memory", "rasterizer")  # for the whole batch, not a scene


@dataclass(frozen=True)
class Job:
    """One scene's evaluation.  alone: it is the only one, and its results go right into the output folder."""

    name: str
    options: "Evaluate"
    alone: bool = False


def jobs_of(options: "Evaluate") -> list[Job]:
    """The scenes that the command line or its batch file names.

    Raises:
        UsageError: the options name no scenes, or too many ways at once.
        FormatError: the batch file is not what it should be.
    """
    if options.batch is not None:
        named = options.others.more or options.scene.scene or options.scene.model_path
        if named:
            raise UsageError("--batch", f"names the scenes; leave {named} out")
        jobs = _from_file(options.batch, options)
    elif options.others.more:
        jobs = _from_words(options)
    else:
        return [Job(options.scene.path.stem, options, alone=True)]
    output = jobs[0].options.output
    if output is None:
        raise UsageError("-o FOLDER", "is needed where there are several scenes")
    overwrite = options.overwrite or options.resume
    refuse_existing([output / name for name in FILES], overwrite)
    slugs = _slugs([job.name for job in jobs])
    return [
        replace(job, options=replace(job.options, output=output / slug))
        for job, slug in zip(jobs, slugs, strict=True)
    ]


def _from_words(options: "Evaluate") -> list[Job]:
    paths = [options.scene.path, *options.others.more]
    if options.cameras.cameras is None and any(path.is_file() for path in paths):
        raise UsageError("--cameras", "is needed, or name model folders, which hold their own")
    return [
        Job(
            path.stem if path.is_file() else path.name,
            replace(
                options,
                others=replace(options.others, more=()),
                scene=replace(options.scene, scene=path, model_path=None),
            ),
        )
        for path in paths
    ]


def _from_file(path: Path, options: "Evaluate") -> list[Job]:
    """The file's scenes, with what it does not say from the command line."""
    file = read_batch(path)
    base = replace(options, batch=None)
    shared = _set(path, "at the top", base, file.shared, NOT_IN_A_FILE)
    return [
        Job(name, _set(path, f"scene '{name}'", shared, settings, (*NOT_IN_A_FILE, *ONCE)))
        for name, settings in file.scenes.items()
    ]


def _set(
    path: Path,
    where: str,
    base: "Evaluate",
    settings: Mapping[str, Any],
    refused: Sequence[str],
) -> "Evaluate":
    """The options with a table's settings: each is read as the flag of its name, so that both mean the same."""
    from .evaluate import Evaluate

    known = _flags()
    for key, value in settings.items():
        if key not in known or key in refused:
            close = difflib.get_close_matches(key, [k for k in known if k not in refused], 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise FormatError(path, f"{where}: {key} is no setting here{hint}")
        if value is False:
            base = _off(base, key)
            continue
        words = _words(key, value)
        try:
            with redirect_stderr(StringIO()):  # tyro words its complaints for a command line
                base = tyro.cli(Evaluate, args=words, default=base, config=CONFIG)
        except SystemExit as error:
            raise FormatError(
                path,
                f"{where}: {key} = {value!r} does not fit; `aaplug evaluate --help` says what does",
            ) from error
    return base


def _flags() -> set[str]:
    """Every setting's name."""
    from .evaluate import Evaluate

    names: set[str] = set()
    for field in Evaluate.__dataclass_fields__.values():
        inner = getattr(field.type, "__dataclass_fields__", None)
        names |= {field.name} if inner is None else set(inner)
    return names


def _off(options: Any, key: str) -> Any:
    """The options with a flag taken back, which no word of the command line does."""
    if isinstance(getattr(options, key, None), bool):
        return replace(options, **{key: False})
    groups = {
        n: _off(g, key) for n, g in vars(options).items() if hasattr(g, "__dataclass_fields__")
    }
    return replace(options, **groups)


def _words(key: str, value: Any) -> list[str]:
    """A setting as words of the command line."""
    if key == "scene":
        return [str(value)]
    name = "--" + key.replace("_", "-")
    if value is True:
        return [name]
    values = value if isinstance(value, list) else [value]
    return [name, *map(str, values)]


def _slugs(names: Sequence[str]) -> list[str]:
    slugs = [re.sub(r"[^\w.\-]+", "_", name).lstrip(".") or "scene" for name in names]
    if len({slug.casefold() for slug in slugs}) < len(slugs):
        return [f"{index:03d}_{slug}" for index, slug in enumerate(slugs)]
    return slugs


def run_batch(
    jobs: Sequence[Job], run: Callable[[Job], Report]
) -> tuple[dict[str, Report], dict[str, str]]:
    """The reports of the scenes that worked out, and what went wrong with the others."""
    reports: dict[str, Report] = {}
    failures: dict[str, str] = {}
    for job in jobs:
        say(f"--- {job.name}")
        try:
            reports[_key(job)] = run(job)
        except AaplugError as error:
            failures[_key(job)] = str(error)
        except MemoryError:
            failures[_key(job)] = "out of memory"
        except Exception as error:  # our own mistake must not cost the other scenes
            log.print(escape(traceback.format_exc()))
            failures[_key(job)] = f"unexpected {type(error).__name__}: {error}"
        if _key(job) in failures:
            log.print(f"[red]failed:[/] {escape(job.name)}: {escape(failures[_key(job)])}")
    return reports, failures


def _key(job: Job) -> str:
    """Two scenes may share a name, but not a folder."""
    assert job.options.output is not None
    return job.options.output.name


def finish_batch(
    options: "Evaluate",
    jobs: Sequence[Job],
    reports: Mapping[str, Report],
    failures: Mapping[str, str],
) -> int:
    """Write batch.json and results.csv, and show the means and the scenes."""
    assert jobs[0].options.output is not None
    folder = jobs[0].options.output.parent
    summary = _summary(jobs, reports, failures)
    make_folder(folder)
    texts = (json.dumps(summary, indent=1, allow_nan=False) + "\n", as_csv(reports))
    for name, text in zip(FILES, texts, strict=True):
        with replacing(folder / name, overwrite=True) as stream:  # it was asked at the start
            stream.write(text.encode())
        say(f"wrote {folder / name}")
    if options.json:
        print_json(summary)
    else:
        out.print(*_tables(jobs, reports, failures, summary["mean"]))
    return FAILED if failures else 0


def _summary(
    jobs: Sequence[Job], reports: Mapping[str, Report], failures: Mapping[str, str]
) -> dict[str, Any]:
    """Status of every scene, and the means over those that are done, of methods that all of them have."""
    scenes = {
        _key(job): {"name": job.name, "status": "failed", "error": failures[_key(job)]}
        if _key(job) in failures
        else {"name": job.name, "status": "done"}
        for job in jobs
    }
    found = [results(report) for report in reports.values()]
    mean: dict[str, dict[str, float | None]] = {}
    for name in (name for name in (found[0] if found else ()) if name != "_aaplug"):
        if all(name in result for result in found):
            mean[name] = {
                metric: _mean([result[name].get(metric) for result in found])
                for metric in found[0][name]
            }
    return {"scenes": scenes, "mean_over": list(reports), "mean": mean}


def _mean(values: Sequence[float | None]) -> float | None:
    """None where a scene has none: means over different scenes do not compare."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def _tables(
    jobs: Sequence[Job],
    reports: Mapping[str, Report],
    failures: Mapping[str, str],
    means: Mapping[str, Mapping[str, float | None]],
) -> list[Table]:
    grids = []
    first = next(iter(reports.values()), None)
    for metric in first.metrics if first else ():
        unit = f" [{metric.unit}]" if metric.unit else ""
        count = f"mean of {len(reports)} scene{'s' * (len(reports) != 1)}"
        grid = Table(title=escape(f"{metric.name}{unit}, {count}"), title_justify="left")
        grid.add_column("recipe", no_wrap=True)
        assert first is not None
        for scale in first.scales:
            grid.add_column(scale_name(scale), justify="right", no_wrap=True)
        for recipe in first.recipes:
            values = [means.get(method(recipe, s), {}).get(metric.name) for s in first.scales]
            grid.add_row(
                escape(recipe), *["–" if v is None else f"{v:.{metric.digits}f}" for v in values]
            )
        grids.append(grid)
    scenes = Table(title="scenes", title_justify="left")
    for heading in ("scene", "status", "why"):
        scenes.add_column(heading, overflow="fold")
    for job in jobs:
        why = failures.get(_key(job))
        status = "done" if why is None else "[red]failed[/]"
        scenes.add_row(escape(job.name), status, escape(why or ""))
    return [*grids, scenes]
