"""Batch: evaluate many scenes.  One that fails stops no other; the summary names it."""

import json
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, TypeVar

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.data_sets import Paper, data_set_of, paper
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.protocols import Protocol
from aaplug.evaluation.report.files import as_json, remove_run, write_texts
from aaplug.evaluation.results import Report, as_csv, literal, method, metric_grid, results
from aaplug.io.atomic import AnyPath, refuse_existing, refuse_inputs, writing
from aaplug.system.contracts import contract
from aaplug.system.errors import AaplugError, ClusterError, counted, within_memory
from aaplug.system.monitor import SILENT, Monitor
from aaplug.verbs.evaluate import check_results
from aaplug.verbs.views import file_names

SUMMARY, RESULTS, TABLE = "batch.json", "results.csv", "table.tex"

T = TypeVar("T")


@dataclass(frozen=True)
class Batch:
    """Outcomes of the scenes, by the names of their folders: a report, or in words why there is none.

    protocol: of a data set, whose scenes these are; then there are no means unless all have finished.
    partly: give the means of those that have finished all the same.
    """

    names: Mapping[str, str]
    reports: Mapping[str, Report]
    failures: Mapping[str, str]
    protocol: Protocol | None = None
    partly: bool = False

    @property
    def whole(self) -> bool:
        """True if means may be taken."""
        return bool(self.reports) and (self.protocol is None or self.partly or not self.failures)

    def papers(self) -> list[Paper]:
        """Of a data set, a table for each metric as papers print it."""
        if self.protocol is None or not self.whole:
            return []
        named = {self.names[folder]: report for folder, report in self.reports.items()}
        first = next(iter(self.reports.values()))
        return [paper(self.protocol, named, metric) for metric in first.compared]

    def summary(self) -> dict[str, Any]:
        """Status of every scene, and means over the finished ones of what all of them measured; JSON-ready."""
        scenes = {folder: {"name": name, "status": "done"} for folder, name in self.names.items()}
        for folder, error in self.failures.items():
            scenes[folder] |= {"status": "failed", "error": error}
        over = list(self.reports) if self.whole else []
        return {"scenes": scenes, "mean_over": over, "mean": self._means() if self.whole else {}}

    def _means(self) -> dict[str, dict[str, float | None]]:
        """By method and metric; None where a scene has no value, or one by another protocol: such do not compare."""
        first, *others = reports = [*self.reports.values()]
        figures, means = [results(report) for report in reports], dict[str, dict[str, float | None]]()
        unlike = {m.name for m in first.metrics if any(r.basis(m.name) != first.basis(m.name) for r in others)}
        for name in figures[0]:
            if name != "_aaplug" and all(name in each for each in figures):
                values = {key: [each[name].get(key) for each in figures] for key in figures[0][name]}
                lacking = unlike | {key for key, each in values.items() if None in each}
                means[name] = {key: None if key in lacking else fmean(each) for key, each in values.items()}
        return means

    def tables(self) -> list[Table | str]:
        """The means, one table per metric, and the status of every scene."""
        whys = [(name, self.failures.get(folder, "")) for folder, name in self.names.items()]
        scenes = status_table("why", [(name, "failed" if why else "done", why) for name, why in whys])
        if not self.whole:
            return [scenes]
        if self.protocol is not None:
            printed = list[Table | str]()
            for paper in self.papers():
                table = Table(title=escape(paper.title), title_justify="left")
                for i, heading in enumerate(paper.headings):
                    table.add_column(heading, justify="right" if i else "left", no_wrap=i > 0, overflow="fold")
                for row in paper.rows:
                    table.add_row(*(Text(cell.replace(" ±", "\n±")) for cell in row))
                printed.append(table)
            return [*printed, scenes]
        first, means, grids = next(iter(self.reports.values())), self._means(), list[Table | str]()
        over = f"mean of {counted(len(self.reports), 'scene')}"
        for metric in first.metrics:
            values = [[means.get(method(r, s), {}).get(metric.name) for s in first.scales] for r in first.recipes]
            lines = [[metric.text(value) for value in line] for line in values]
            grids += metric_grid(f"{metric.title}, {over}", [*self.reports.values()], metric, lines)
        return [*grids, scenes]


def status_table(heading: str, rows: Iterable[tuple[str, str, str]]) -> Table:
    """A table of the scenes: name, status, and a text under the heading."""
    table = Table(title="scenes", title_justify="left")
    for column in ("scene", "status", heading):
        table.add_column(column, overflow="fold")
    for name, status, text in rows:
        status = "[red]failed[/]" if status == "failed" else status
        table.add_row(literal(name), status, literal(text))
    return table


@contract
def batch(
    runs: Sequence[tuple[str, Callable[..., Report]]],
    output: AnyPath,
    *,
    resume: bool = False,
    overwrite: bool = False,
    protocol: str | None = None,
    partly: bool = False,
    monitor: Monitor = SILENT,
) -> Batch:
    """Evaluate scenes into folders of their own, and write batch.json and results.csv beside these.

    Args:
        runs: scenes by name, each as `functools.partial(evaluate, scene, cameras, ...)`; called with `name`,
            `output`, `resume`, `overwrite` and `monitor`.
        output: folder of the scenes' folders.
        protocol: of a data set, whose scenes these are: also write table.tex, a table as papers print it.  There are no
            means unless all scenes finish.
        partly: give the means of those that finish all the same.

    Raises:
        AaplugError: there are results already, an option does not fit, or the summary cannot be written.
    """
    output, found = Path(output), None
    if protocol is not None:
        data_set_of(protocol)  # refuses what has none
        found = PROTOCOLS[protocol]
    folders = [output / slug for slug in file_names([name for name, _ in runs], "scene", 3)]

    def check() -> None:
        refuse_existing([output / name for name in (SUMMARY, RESULTS, TABLE)], overwrite, resume)
        for folder in folders:
            check_results(folder, resume, overwrite)

    check()
    reports, failures = dict[str, Report](), dict[str, str]()
    with writing(output, check, (), folder=True):
        for folder, (name, run) in zip(folders, runs, strict=True):
            monitor.say(f"--- {name}")
            options = {"name": name, "output": folder, "resume": resume, "overwrite": overwrite, "monitor": monitor}
            report = outcome(partial(run, **options), monitor)
            if isinstance(report, Report):
                reports[folder.name] = report
            else:
                failures[folder.name] = report
                monitor.say(f"failed: {name}: {report}")
        names = {folder.name: name for folder, (name, _) in zip(folders, runs, strict=True)}
        done = Batch(names, reports, failures, found, partly)
        if resume and not reports and (output / SUMMARY).exists():
            monitor.say(f"no scene finished: {output / SUMMARY} and what is beside it stay as they were")
            return done
        if overwrite:  # what an earlier batch wrote beyond these scenes, as its summary tells, is removed
            with suppress(OSError, ValueError, LookupError, TypeError):  # no summary, or a damaged one
                scenes = json.loads((output / SUMMARY).read_bytes())["scenes"]
                for journal in output.glob(f"*/{JOURNAL}"):
                    if journal.parent.name in scenes and journal.parent.name not in names:
                        remove_run(journal.parent)
                refuse_inputs([output / TABLE])
                (output / TABLE).unlink(missing_ok=True)
        texts = {SUMMARY: as_json(done.summary()), RESULTS: as_csv(reports)}
        if papers := done.papers():
            texts[TABLE] = "\n".join(paper.as_latex() for paper in papers)
        for path in write_texts(output, texts, overwrite=True):  # checked at the start
            monitor.say(f"wrote {path}")
    return done


def outcome(run: Callable[[], T], monitor: Monitor) -> T | str:
    """The result of one scene of many, or in words why there is none."""
    try:
        with within_memory("scene"):
            return run()
    except ClusterError:  # the next scene would end alike
        raise
    except AaplugError as error:
        return str(error)
    except Exception as error:  # a mistake in aaplug must not cost the other scenes
        monitor.say(traceback.format_exc())
        return f"unexpected {type(error).__name__}: {error}"
