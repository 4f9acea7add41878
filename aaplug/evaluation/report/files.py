"""The files of an evaluation: results.json, per_view.json, results.csv, report.html and its plots."""

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.results import Facts, Report, as_csv, per_view, results
from aaplug.inspection.coverage import Coverage
from aaplug.io.atomic import make_folder, replacing

RESULTS = ("results.json", "per_view.json", "results.csv")
PAGE, PLOTS = "report.html", "plots"


def as_json(data: Any) -> str:
    """Strict JSON, as files hold it."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def write_texts(folder: str | PathLike[str], texts: Mapping[str, str], overwrite: bool) -> list[Path]:
    """Write texts, by file name, into a folder, which is made if needed; return the paths."""
    paths = [make_folder(folder) / name for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        with replacing(path, overwrite) as stream:
            stream.write(text.encode(errors="backslashreplace"))  # a file's name need not be UTF-8
    return paths


def write_results(report: Report, folder: str | PathLike[str], overwrite: bool, name: str = "scene") -> list[Path]:
    """Write results.json, per_view.json and results.csv; return their paths."""
    texts = (as_json(results(report)), as_json(per_view(report)), as_csv({name: report}))
    return write_texts(folder, dict(zip(RESULTS, texts, strict=True)), overwrite)


def write_page(
    folder: str | PathLike[str],
    name: str,
    report: Report,
    found: Coverage,
    images: ImageStore,
    overwrite: bool,
    facts: Sequence[Facts] = (),
) -> list[Path]:
    """Write report.html, and its plots as PNG and SVG into plots/; return both paths.

    facts: further tables of text, as title, headings and rows.
    """
    # matplotlib takes most of a second to import
    from aaplug.evaluation.report.plots import plots
    from aaplug.evaluation.report.webpage import page

    drawn = plots(report, found)
    written = write_texts(folder, {PAGE: page(name, report, found, drawn, images, facts)}, overwrite)
    beside = make_folder(Path(folder) / PLOTS)
    for plot in drawn:
        for suffix, data in ((".png", plot.png()), (".svg", plot.svg().encode())):
            with replacing(beside / (plot.name + suffix), overwrite=True) as stream:
                stream.write(data)
    return [*written, beside]
