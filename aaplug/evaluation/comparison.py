"""Scenes held to the first of them: how their Gaussians differ, and their results as data and in print.

Every scene is a row of a `Report` whose truth is the first of them, the reference.

Gaussians are compared one by one where two scenes have the same number.  Some programs sort the Gaussians.  Where rows
are not the same Gaussians, those are paired that are each other's nearest neighbours (positions that a format rounded
to the same place lose their partners).

n: Gaussians, m: pairs.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from statistics import median
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.spatial import KDTree
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.evaluation.alignment import PAIR_DISTANCE, mismatch
from aaplug.evaluation.metrics import EQUAL, PSNR
from aaplug.evaluation.results import Facts, Report, literal, mean, spread_of, tables
from aaplug.io.image_files import file_names
from aaplug.io.scenes import SceneLike, scene_of
from aaplug.io.scenes.columns import usable
from aaplug.io.scenes.scene import Scene
from aaplug.system.errors import FrameError, UsageError

GUARDED = (
    "the lowest, over later scenes and scales, of the mean PSNR of views whose images differ, in dB; null if none do"
)
UNKNOWN = "–"
GAP = 3  # characters between columns in print

Say = Callable[[str], None]
log = logging.getLogger("aaplug")


@dataclass(frozen=True)
class Change:
    """Absolute differences of one quantity over the pairs: root mean square, median and largest."""

    rms: float
    median: float
    largest: float

    @classmethod
    def of(cls, values: Float[Tensor, "*m"]) -> "Change":
        """The change by differences or their lengths; 0 if there are none."""
        if not values.numel():
            return cls(0.0, 0.0, 0.0)
        sizes = values.double().abs().flatten()
        return cls(float(sizes.square().mean().sqrt()), float(sizes.median()), float(sizes.max()))


@dataclass(frozen=True)
class Differences:
    """The changes from one scene to another.

    paired: share of the Gaussians that have a partner.  sorted: true if the order changed.
    changes: of "positions" in world units, "scales" as ln σ, axis by axis from the thinnest, "opacities" in [0, 1], and
        the coefficients of each degree ("SH 0"), of which those that one scene lacks count as 0.
    """

    paired: float
    sorted: bool
    changes: Mapping[str, Change]


def differences(reference: Gaussians, other: Gaussians) -> Differences | None:
    """The changes from the reference to the other; None where their counts differ or there is no Gaussian."""
    if len(reference) != len(other) or not len(reference):
        return None
    first, second = reference, other
    distances = (reference.means.double() - reference.means.double().median(dim=0).values).norm(dim=1)
    moves = (reference.means.double() - other.means.double()).norm(dim=1)
    same_rows = float(moves.median()) <= PAIR_DISTANCE * float(distances.median())
    if not same_rows:
        there, back = _nearest(reference, other), _nearest(other, reference)
        mutual = back[there] == torch.arange(len(reference))
        first, second = reference[mutual], other[there[mutual]]
    a, b = (scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).sort(dim=1).values for scene in (first, second))
    most = max(first.sh.shape[1], second.sh.shape[1])
    one, two = (torch.nn.functional.pad(s.sh, (0, 0, 0, most - s.sh.shape[1])) for s in (first, second))
    changes = {
        "positions": (first.means.double() - second.means.double()).norm(dim=1),
        "scales": a.double() - b.double(),
        "opacities": first.opacities.double() - second.opacities.double(),
        **{f"SH {d}": (one - two)[:, d * d : (d + 1) ** 2] for d in range(round(most**0.5))},
    }
    return Differences(len(first) / len(reference), not same_rows, {k: Change.of(v) for k, v in changes.items()})


def _nearest(scene: Gaussians, among: Gaussians) -> Int[Tensor, " n"]:
    """Row of the nearest of the others, for each Gaussian."""
    tree = KDTree(among.means.detach().double().numpy())
    return torch.from_numpy(tree.query(scene.means.detach().double().numpy())[1]).long()


@dataclass(frozen=True)
class ComparedScene:
    """A scene of a comparison.

    file, bytes: None of a scene that came from no file.
    frame: its frame against the reference's, in words; None if the same.
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
        facts = asdict(self)
        if found := facts["differences"]:
            facts["differences"] = found | found.pop("changes")
        return facts


def named_scenes(scenes: Mapping[str, SceneLike] | Sequence[SceneLike]) -> dict[str, Scene]:
    """The scenes by name, opened; without names they get those of their files, numbered where two are the same.

    Raises UsageError if there are fewer than two.
    """
    opened = [scene_of(scene, still=True) for scene in (scenes.values() if isinstance(scenes, Mapping) else scenes)]
    if len(opened) < 2:
        problem = f"needs two scenes or more, got {len(opened)}; the others are compared with the first"
        raise UsageError("compare", problem)
    if isinstance(scenes, Mapping):
        return dict(zip(scenes, opened, strict=True))
    titles = [scene.title for scene in opened]
    longer = [f"{s.file.parent.name}/{name}" if s.file else name for name, s in zip(titles, opened, strict=True)]
    names = longer if len(set(titles)) < len(set(longer)) == len(longer) else titles
    return dict(zip(file_names(names, "scene", 1), opened, strict=True))


def in_one_frame(scenes: Mapping[str, Scene], say: Say = lambda text: None) -> dict[str, Scene]:
    """The scenes; where a file can be read in two ways and another scene's in one, the reading in that one's frame."""
    certain = next((name for name, scene in scenes.items() if scene.other is None), None)
    if certain is None or all(scene.other is None for scene in scenes.values()):
        return dict(scenes)
    reference, settled = usable(scenes[certain].raw(0, scenes[certain].count)), dict[str, Scene]()
    for name, scene in scenes.items():
        settled[name] = scene
        if scene.other is None:
            continue
        readings = scene.decoded(), scene.other.decoded()
        fits = [mismatch(reference, usable(reading.raw(0, reading.count))) is None for reading in readings]
        if fits[0] != fits[1]:
            settled[name] = reading = readings[fits[1]]
            say(f"{scene.title}: {reading.notes[-1].partition(' (')[0]}, as fits {certain}")
    return settled


def compared_scenes(
    scenes: Mapping[str, Scene], any_frame: bool = False, say: Say = lambda text: None
) -> tuple[ComparedScene, ...]:
    """Facts of the scenes, the reference first; says what they lack.

    any_frame: warn of a scene in another frame than the reference's, instead of raising FrameError.
    """
    reference, first = next((name, scene.gaussians()) for name, scene in scenes.items())
    rows: list[ComparedScene] = []
    for name, scene in scenes.items():
        gaussians = scene.gaussians()
        frame = mismatch(first, gaussians) if rows else None
        if frame is not None:
            problem = f"is {reference} {frame}"
            if not any_frame:
                raise FrameError(name, f"{problem}; bring both into one frame, or pass `any_frame`")
            log.warning("%s: %s", name, problem)
        if gaussians.sh_degree != first.sh_degree:
            degrees = f"{name}: has SH degree {gaussians.sh_degree}, {reference} {first.sh_degree}"
            say(f"{degrees}: what one lacks counts as a difference from 0")
        rows.append(
            ComparedScene(
                name=name,
                file=scene.file and scene.file.name,
                format="levels" if scene.levels is not None else scene.format or None,
                bytes=scene.bytes,
                gaussians=len(gaussians),
                sh_degree=gaussians.sh_degree,
                convention=gaussians.convention.name,
                frame=frame,
                differences=differences(first, gaussians) if rows else None,
            )
        )
    return tuple(rows)


class Lowest(NamedTuple):
    """A mean PSNR in dB, infinite where all images are equal, with its scene and scale."""

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
        """The worst scene at its worst scale, by mean PSNR: the figure that `aaplug compare --fail-under` guards."""
        cases = []
        for scene, scale in product(self.scenes[1:], self.report.scales):
            value = mean(self.report.select(scene.name, scale), PSNR.name)
            cases.append(Lowest(math.inf if value is None else value, scene.name, scale))
        return min(cases)

    def summary(self) -> dict[str, Any]:
        """Everything, JSON-ready."""
        value, worst, scale = self.lowest
        guard = {"figure": GUARDED, "value": None if value == math.inf else value, "scene": worst, "scale": scale}
        report, scenes = self.report, dict[str, Any]()
        for scene in self.scenes:
            scales = dict[str, Any]()
            for scale in report.scales:
                views = report.select(scene.name, scale)
                scales[f"{scale:g}"] = {
                    **{metric.name: spread_of(metric, views) for metric in report.metrics},
                    "equal_views": sum(EQUAL in view.note for view in views),
                    "seconds": median(view.seconds for view in views),
                    "per_view": {v.view: {**v.values, "seconds": round(v.seconds, 4)} for v in views},
                }
            scenes[scene.name] = scene.as_json() | {"scales": scales}
        protocol = {**report.protocol, "notes": report.notes}
        return {"reference": self.reference.name, "guard": guard, "scenes": scenes, "protocol": protocol}

    def tables(self) -> list[Table | str]:
        """The scenes, how their Gaussians differ, and every metric over scales."""
        facts = []
        for title, headings, rows in self.facts():
            room = Console().width - max(map(len, headings))
            across = max(1, room // (GAP + max(len(cell) for row in rows for cell in row)))
            for first in range(0, len(rows), across):
                table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
                names, *lines = zip(headings, *rows[first : first + across], strict=True)  # scenes side by side
                for place, name in enumerate(names):
                    table.add_column(literal(name), justify="right" if place else "left", overflow="fold")
                for row in lines:
                    table.add_row(*map(literal, row))
                facts.append(table)
        return [*facts, *tables(self.report)]

    def facts(self) -> list[Facts]:
        """The scenes, and how their Gaussians differ, as tables of title, headings and rows of text."""
        reference, rows = self.reference, []
        for scene in self.scenes:
            size = UNKNOWN if scene.bytes is None else f"{scene.bytes:,}"
            if scene is not reference and reference.bytes and scene.bytes is not None:
                size += f" ({scene.bytes / reference.bytes:.1%})"
            facts = f"{scene.gaussians:,}", str(scene.sh_degree), scene.convention
            rows.append([scene.name, scene.format or "in memory", size, *facts])
        headings = ["scene", "format", "bytes", "Gaussians", "SH degree", "convention"]
        changed = [(scene.name, scene.differences) for scene in self.scenes if scene.differences is not None]
        if not changed:
            return [("scenes", headings, rows)]
        names, lines = max((list(each.changes) for _, each in changed), key=len), []
        for scene, each in changed:
            cells = [f"{each.changes[name].rms:.2g}" if name in each.changes else UNKNOWN for name in names]
            lines.append([scene, *cells, f"{each.paired:.1%}{', sorted' * each.sorted}"])
        title = "differences of the Gaussians, root mean square"
        return [("scenes", headings, rows), (title, ["scene", *names, "paired"], lines)]
