"""Sets of scenes that papers report on: how their folders lie, and a table as the papers print it."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import NamedTuple

from aaplug.evaluation.metric import Metric
from aaplug.evaluation.protocols import Protocol
from aaplug.evaluation.results import Report, mean, scale_name
from aaplug.io.scenes.scene import MODEL_SCENE
from aaplug.system.errors import FormatError, UsageError, listing, not_one_of


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
