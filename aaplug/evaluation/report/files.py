"""The files of an evaluation, of a comparison of scenes, and of both: a page with its plots."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any

from aaplug.evaluation.coverage import Coverage
from aaplug.evaluation.image_store import RENDERS, REPORT_FOLDER, TEST_FOLDER, TRUTHS, ImageStore
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.results import CEILING, Facts, Report, method
from aaplug.io.atomic import make_folder, refuse_inputs, write_file

RESULTS = ("results.json", "per_view.json", "results.csv")
COMPARED = ("compare.json", "compare.csv", "contact-sheet.png")
PAGE, PLOTS, PLOT_SUFFIXES = "report.html", "plots", (".png", ".svg")


def remove_run(folder: Path) -> None:
    """Remove the files that an earlier run wrote, as its journal tells, and folders that are then empty."""
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):  # no journal, or a damaged one
        with (folder / JOURNAL).open("rb") as stream:
            request = json.loads(stream.readline())["request"]
        shown, layout = request["options"]["shown"], request["options"].get("layout")
        stores = [REPORT_FOLDER] * (shown is not None) + [TEST_FOLDER] * (layout == "inria")
        methods = [method(name, scale) for scale in request["scales"] for name in (CEILING, *request["recipes"])]
        numbers = [f"{view:05d}.png" for view in range(len(request["view_names"]))]
        images = product(stores, methods, (RENDERS, TRUTHS), numbers)
        files = {*map(Path, (JOURNAL, *(COMPARED if "reference" in request else RESULTS))), *(Path(*i) for i in images)}
        if shown is not None:
            from aaplug.evaluation.report.plots import ABOVE_NYQUIST, BOUNDS, EVALUATIONS, plot_name

            names = map(plot_name, (*request["metrics"], EVALUATIONS, ABOVE_NYQUIST, BOUNDS))
            files |= {Path(PAGE), *(Path(PLOTS, name + suffix) for name, suffix in product(names, PLOT_SUFFIXES))}
        refuse_inputs(folder / file for file in files)
        folders = {parent for file in files for parent in file.parents}
        for path in [*sorted(folder.rglob("*"), reverse=True), folder]:  # a folder comes after what it holds
            name = path.relative_to(folder)
            with suppress(OSError):  # the folder is not empty
                if name in files:
                    path.unlink()
                elif name in folders:
                    path.rmdir()


def write_page(
    name: str, report: Report, bounds: Coverage, images: ImageStore, overwrite: bool, facts: Sequence[Facts] = ()
) -> list[Path]:
    """Write report.html beside its images, its plots into plots/; return both paths.  facts: further tables."""
    # matplotlib takes most of a second to import
    from aaplug.evaluation.report.plots import plots
    from aaplug.evaluation.report.webpage import page

    figures = plots(report, bounds)
    text = page(name, report, bounds, figures, images, facts)
    drawn = {plot.name: (plot.png(), plot.svg().encode()) for plot in figures}
    paths, beside = write_texts(images.folder, {PAGE: text}, overwrite), make_folder(images.folder / PLOTS)
    for plot, kinds in drawn.items():
        for suffix, data in zip(PLOT_SUFFIXES, kinds, strict=True):
            write_file(beside / (plot + suffix), data, overwrite=True)
    return [*paths, beside]


def write_texts(folder: str | PathLike[str], texts: Mapping[str, str], overwrite: bool) -> list[Path]:
    """Write texts, by file name, into a folder, which is made if needed; return the paths."""
    paths = [make_folder(folder) / name for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_file(path, text.encode(errors="backslashreplace"), overwrite)  # a file's name need not be UTF-8
    return paths


def as_json(data: Any) -> str:
    """Strict JSON, as files hold it."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"
