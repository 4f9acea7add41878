"""The results of a comparison of scenes as data and in print: what each scene is, how it differs, how near it looks.

Every scene is a row of a `Report` whose truth is the first of them, the reference.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median, stdev
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from aaplug.core.errors import printable
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.metrics import EQUAL, PSNR
from aaplug.evaluation.results import Facts, Measurement, Report, mean, tables
from aaplug.inspection.differences import Differences

GUARDED = (
    "the lowest, over scenes and scales, of the mean PSNR of the views whose images differ, in dB; null if none do"
)
UNKNOWN = "–"


@dataclass(frozen=True)
class ComparedScene:
    """What a scene is.

    file, bytes: None of a scene that came from no file.
    frame: what its frame is against the reference's, in words; None if the same.
    differences: from the reference, Gaussian by Gaussian; None where the counts differ.
    """

    name: str
    file: str | None
    format: str | None
    bytes: int | None
    gaussians: int
    sh_degree: int
    convention: str
    frame: str | None = None
    differences: Differences | None = None

    def as_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return vars(self) | {"differences": self.differences and self.differences.as_json()}


class Lowest(NamedTuple):
    """A mean PSNR in dB, infinite where all images are equal, and where it was found."""

    value: float
    scene: str
    scale: float


@dataclass(frozen=True)
class Comparison:
    """Two or more scenes, the reference first, and the measurements of all of them."""

    scenes: tuple[ComparedScene, ...]
    report: Report

    @property
    def reference(self) -> ComparedScene:
        """The scene that the others are compared with."""
        return self.scenes[0]

    @property
    def lowest(self) -> Lowest:
        """The worst scene at its worst scale, by mean PSNR: what `aaplug compare --fail-under` guards."""
        found = [Lowest(_psnr(self.report, s.name, r), s.name, r) for s in self.scenes[1:] for r in self.report.scales]
        return min(found)

    def summary(self) -> dict[str, Any]:
        """Everything, JSON-ready."""
        value, scene, scale = self.lowest
        guard = {"figure": GUARDED, "value": None if value == math.inf else value, "scene": scene, "scale": scale}
        scenes = {scene.name: scene.as_json() | {"scales": self._figures(scene.name)} for scene in self.scenes}
        protocol = {**self.report.protocol, "notes": self.report.notes}
        return {"reference": self.reference.name, "guard": guard, "scenes": scenes, "protocol": protocol}

    def _figures(self, name: str) -> dict[str, Any]:
        """By scale: every metric and the time of a frame over the views, and view by view."""
        return {f"{s:g}": _statistics(self.report.metrics, self.report.select(name, s)) for s in self.report.scales}

    def tables(self) -> list[Table]:
        """What the scenes are, how their Gaussians differ, and every metric over scales."""
        return [*self.facts(), *tables(self.report)]

    def facts(self) -> list[Table]:
        """What the scenes are, and how their Gaussians differ."""
        return [_table(title, headings, rows) for title, headings, rows in self.cells()]

    def cells(self) -> list[Facts]:
        """Tables as title, headings and rows of text."""
        found = [("scenes", ["scene", "format", "bytes", "Gaussians", "SH degree", "convention"], self._scene_rows())]
        if changed := [scene for scene in self.scenes if scene.differences is not None]:
            names = max((list(s.differences.named) for s in changed if s.differences), key=len)
            title = "differences of the Gaussians, root mean square"
            found.append((title, ["scene", *names, "paired"], [_difference_row(scene, names) for scene in changed]))
        return found

    def _scene_rows(self) -> list[list[str]]:
        whole, rows = self.reference.bytes, []
        for scene in self.scenes:
            size = UNKNOWN if scene.bytes is None else f"{scene.bytes:,}"
            if scene is not self.reference and whole and scene.bytes is not None:
                size += f" ({scene.bytes / whole:.1%})"
            facts = f"{scene.gaussians:,}", str(scene.sh_degree), scene.convention
            rows.append([scene.name, scene.format or "in memory", size, *facts])
        return rows


def _psnr(report: Report, name: str, scale: float) -> float:
    found = mean(report.select(name, scale), PSNR.name)
    return math.inf if found is None else found


def _statistics(metrics: Sequence[Metric], views: Sequence[Measurement]) -> dict[str, Any]:
    found = {metric.name: _spread(metric, {v.view: v.values.get(metric.name) for v in views}) for metric in metrics}
    return {
        **found,
        "equal_views": sum(EQUAL in view.note for view in views),
        "seconds": median(view.seconds for view in views),
        "per_view": {v.view: {**v.values, "seconds": round(v.seconds, 4)} for v in views},
    }


def _spread(metric: Metric, values: Mapping[str, float | None]) -> dict[str, Any] | None:
    """Mean, median, worst and standard deviation over the views where the metric is defined; None if nowhere."""
    known = {view: value for view, value in values.items() if value is not None}
    if not known:
        return None
    worst = max(known, key=lambda view: metric.loss(known[view]))
    return {
        "mean": sum(known.values()) / len(known),
        "median": median(known.values()),
        "worst": {"view": worst, "value": known[worst]},
        "spread": stdev(known.values()) if len(known) > 1 else None,
    }


def _difference_row(scene: ComparedScene, names: Sequence[str]) -> list[str]:
    assert scene.differences is not None
    changes = scene.differences.named
    cells = [f"{changes[name].rms:.2g}" if name in changes else UNKNOWN for name in names]
    order = ", sorted" if scene.differences.sorted else ""
    return [scene.name, *cells, f"{scene.differences.paired:.1%}{order}"]


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for place, heading in enumerate(headings):
        table.add_column(heading, justify="right" if place else "left", overflow="fold")
    for row in rows:
        table.add_row(*(escape(printable(cell)) for cell in row))
    return table
