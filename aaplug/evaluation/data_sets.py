"""Many scenes: the sets that papers report on, how their folders lie, and the outcomes as the papers print them."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, NamedTuple

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from aaplug.evaluation.metric import Metric
from aaplug.evaluation.protocols import Protocol
from aaplug.evaluation.results import Report, literal, mean, method, metric_grid, results, scale_name
from aaplug.io.scenes.scene import MODEL_SCENE
from aaplug.system.errors import FormatError, UsageError, counted, listing, not_one_of


@dataclass(frozen=True)
class DataSet:
    """A set of scenes.

    folders: under which it lies in its own archive and in nerfbaselines' results.
    cameras: a file or folder by which a scene's data is known.
    """

    title: str
    folders: tuple[str, ...]
    scenes: tuple[str, ...]
    cameras: str


NERF_SYNTHETIC = DataSet(
    "NeRF-synthetic",
    ("nerf_synthetic", "blender"),
    ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
    "transforms_test.json",
)
MIP_NERF_360 = DataSet(
    "Mip-NeRF 360",
    ("360_v2", "mipnerf360", "mip-nerf360"),
    ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill"),
    "sparse/0",
)
DATA_SETS = {"blender": NERF_SYNTHETIC, "360-zoom-out": MIP_NERF_360, "360-zoom-in": MIP_NERF_360}  # by protocol
# PSNR in dB by method, at each scale and on average (Yu et al., CVPR 2024, arXiv 2311.16493)
PUBLISHED = {
    "blender": {
        "3DGS": (33.33, 26.95, 21.38, 17.69, 24.84),
        "3DGS + EWA": (33.51, 31.66, 27.82, 24.63, 29.40),
        "Mip-Splatting": (33.36, 34.00, 31.85, 28.67, 31.97),
    },
    "360-zoom-in": {
        "3DGS": (29.19, 23.50, 20.71, 19.59, 23.25),
        "3DGS + EWA": (29.30, 25.90, 23.70, 22.81, 25.43),
        "Mip-Splatting": (29.39, 27.39, 26.47, 26.22, 27.37),
    },
}


def data_set_of(protocol: str) -> DataSet:
    """The data set that a protocol is for; raises UsageError if it is for none."""
    if protocol not in DATA_SETS:
        raise UsageError("protocol", f"has no data set of its own: {not_one_of(protocol, DATA_SETS)}")
    return DATA_SETS[protocol]


def _places(data_set: DataSet, root: Path, scene: str) -> Iterator[Path]:
    """Folders where a scene may lie."""
    for folder in (root, *(root / name for name in data_set.folders)):
        yield from (folder / scene, folder / scene / "checkpoint")


def is_set(protocol: str, folder: Path) -> bool:
    """True if a folder holds scenes of the protocol's data set."""
    known = DATA_SETS.get(protocol)
    return known is not None and any(each.is_dir() for s in known.scenes for each in _places(known, folder, s))


def find_scenes(
    protocol: str, data: Path, models: Path | None = None, skip: bool = False
) -> dict[str, tuple[Path, Path]]:
    """Every scene of a protocol's data set, found by its layout: by name the trained scene and the folder of its data.

    Data lies in SCENE or SET/SCENE.  A trained scene is an INRIA model or SCENE.ply in SCENE, SET/SCENE, or checkpoint
    in these.

    models: folder of the trained scenes; None if they lie with the data.
    skip: leave out scenes that are missing, unless all are.

    Raises UsageError if the protocol is not one of a data set, and FormatError if scenes are missing.
    """
    data_set, root = data_set_of(protocol), models or data
    scenes, missing = dict[str, tuple[Path, Path]](), list[str]()
    for scene in data_set.scenes:
        cameras = [place for place in _places(data_set, data, scene) if (place / data_set.cameras).exists()]
        places = [place for place in _places(data_set, root, scene) if place.is_dir()]
        trained = [place for place in places if any(place.glob(MODEL_SCENE))]
        trained += [place / f"{scene}.ply" for place in places if (place / f"{scene}.ply").is_file()]
        if cameras and trained:
            scenes[scene] = trained[0], cameras[0]
            continue
        problems = [] if cameras else [f"no {data_set.cameras} in {data / scene}"]
        problems += [] if trained else [f"no {MODEL_SCENE.replace('*', 'N')} and no {scene}.ply in {root / scene}"]
        missing.append(f"{scene}: {', '.join(problems)}")
    if missing and not (skip and scenes):
        count = f"{len(missing)} of the {len(data_set.scenes)} scenes of {data_set.title}"
        raise FormatError(data, f"lacks {count} (`skip` leaves them out): {'; '.join(missing)}")
    return scenes


class Paper(NamedTuple):
    """A table as papers print it."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]

    def as_latex(self) -> str:
        """The table for a paper: booktabs, ± in small type."""
        lines = [f"% {self.title}", rf"\begin{{tabular}}{{l{'c' * (len(self.headings) - 1)}}}", r"\toprule"]
        lines += [" & ".join(self.headings).replace("×", r"$\times$") + r" \\", r"\midrule"]
        for row in self.rows:
            name, *cells = (re.sub(r"[&%$#_{}]", r"\\\g<0>", cell) for cell in row)
            shown = [cell.replace(" ± ", r" {\scriptsize $\pm$ ") + "}" * ("±" in cell) for cell in cells]
            lines.append(" & ".join([name, *shown]) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def paper(protocol: Protocol, reports: Mapping[str, Report], metric: Metric) -> Paper:
    """A metric by method and scale, as means over scenes ± the standard deviation between them, below the papers'.

    reports: by scene, all of the same recipes and scales.
    """
    data_set, first = DATA_SETS[protocol.name], next(iter(reports.values()))
    without = [scene for scene in data_set.scenes if scene not in reports]
    title = f"{metric.name}, {data_set.title}, mean of {len(reports)} of {len(data_set.scenes)} scenes"
    title += f", without {listing(without, most=9)}" if without else ""

    def cell(values: Sequence[float | None]) -> str:
        known = [value for value in values if value is not None]
        if len(known) < len(values):  # means over different scenes do not compare
            return "-"
        return metric.text(fmean(known)) + (f" ± {metric.text(stdev(known))}" if len(known) > 1 else "")

    rows: list[list[str]] = []
    if metric.name == "PSNR" and tuple(first.scales) == protocol.scales and not without:
        for method, figures in PUBLISHED.get(protocol.name, {}).items():
            rows.append([f"{method} (published)", *(f"{value:.2f}" for value in figures)])
    for recipe in first.recipes:
        values = [[mean(r.select(recipe, s), metric.name) for s in first.scales] for r in reports.values()]
        averages = [None if None in each else fmean(v for v in each if v is not None) for each in values]
        rows.append([recipe, *map(cell, zip(*values, strict=True)), cell(averages)])
    return Paper(title, ["", *map(scale_name, first.scales), "avg"], rows)


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
