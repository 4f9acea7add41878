"""Batch: evaluate many scenes.  One that fails stops no other; the summary names it."""

import json
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.data_sets import Batch, data_set_of
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.report.files import as_json, remove_run, write_texts
from aaplug.evaluation.results import Report, as_csv
from aaplug.io.atomic import AnyPath, refuse_existing, refuse_inputs, writing
from aaplug.io.image_files import file_names
from aaplug.system.contracts import contract
from aaplug.system.errors import AaplugError, ClusterError, within_memory
from aaplug.system.monitor import SILENT, Monitor
from aaplug.verbs.evaluate import check_results

SUMMARY, RESULTS, TABLE = "batch.json", "results.csv", "table.tex"

T = TypeVar("T")


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
