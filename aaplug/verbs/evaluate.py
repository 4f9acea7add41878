"""Recipes measured at several scales, against photographs or the scene's own supersampled look."""

import hashlib
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, get_args

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import OutputError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import MatchesRates, Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Task, candidates_of
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.metrics import default_metrics, find_metrics, metric_option
from aaplug.evaluation.protocols import PROTOCOLS, LpipsFlavour, Protocol, SsimFlavour, TruthSource
from aaplug.evaluation.report.files import PAGE, RESULTS, write_page, write_results
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, own_look, source_of
from aaplug.inspection.coverage import coverage
from aaplug.io.atomic import refuse_existing
from aaplug.io.cameras import select_views
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, USER_RECIPES, find_recipe, suited
from aaplug.rendering.renderer import Background
from aaplug.verbs.inputs import CamerasLike, SceneLike, background_of, cameras_of, processor, rasterizer_of, scene_of

ALL = "all"  # instead of recipes' names: every recipe that the scene suits
DEFAULT_RECIPES = ("classic", "mip", "matched", "auto")
FLAVOURS = {"ssim": get_args(SsimFlavour), "lpips": get_args(LpipsFlavour)}
HASH_BLOCK = 1 << 20  # bytes read at once
JOURNAL = "progress.jsonl"
USER_NAMES = [recipe.name for recipe in USER_RECIPES]
PACKAGES = ("aaplug", "torch", "numpy", "scikit-image", "opencv-contrib-python-headless")

Weights = tuple[str | PathLike[str], str | PathLike[str]]


def evaluate(
    scene: SceneLike,
    cameras: CamerasLike = None,
    *,
    recipe: str | Sequence[str | Recipe] = DEFAULT_RECIPES,
    scale: Sequence[float] | None = None,
    views: str = "test",
    protocol: str | Protocol = "default",
    truth: str = "auto",
    metric: str | Sequence[str] | None = None,
    lpips: Weights | None = None,
    quality: str = "balanced",
    rate_reference: str | None = None,
    background: Background = "auto",
    rasterizer: str | Rasterizer = "auto",
    threads: int | None = None,
    memory: float | None = None,
    cull_margin: float = math.inf,
    min_seen: float = MIN_SEEN_SHARE,
    output: str | PathLike[str] | None = None,
    report: bool = False,
    show: str = "3",
    layout: str = "plain",
    resume: bool = False,
    overwrite: bool = False,
    name: str | None = None,
    monitor: Monitor = SILENT,
) -> Report:
    """Measure recipes at several scales.

    Args:
        scene, cameras, views, quality, rate_reference, background, rasterizer, threads, memory, cull_margin, min_seen,
            monitor: see `render`.
        recipe: recipes or names in `RECIPES`; "all" for every one that the scene suits.
        scale: sizes relative to the training size; None for the protocol's.
        protocol: a protocol, or its name in `PROTOCOLS`.
        truth: "photographs", "self" (the scene's own supersampled look), or "auto" for the protocol's.
        metric: names in `METRICS`, with a flavour where it matters ("ssim:3dgs"); None for `default_metrics`.
        lpips: files of LPIPS's trunk and heads.
        output: folder for results.json, per_view.json and results.csv.
        report: write report.html too.
        show: views in the report's viewer: how many, or names separated by commas.
        layout: "inria" stores every render and its truth in test/METHOD/{renders,gt}.
        resume: do not measure the views again that an interrupted evaluation finished.
        overwrite: replace existing results.
        name: the scene's name in the results; None for its file's.

    Raises:
        AaplugError: an input cannot be read, an argument does not fit, or a result cannot be written.
    """
    out = Output(None if output is None else Path(output), report, layout, resume, overwrite)
    out.check()
    name = name or Path(scene.name if isinstance(scene, Gaussians) else scene).stem
    rules = PROTOCOLS.find(protocol, "protocol") if isinstance(protocol, str) else protocol
    metrics, rules = _metrics(metric, rules, lpips)
    cameras, scene = cameras_of(cameras, scene), scene_of(scene)
    recipes = _recipes(recipe, scene, quality, rate_reference, monitor)
    seen, scales = select_views(cameras, views), scale or rules.scales
    shown = _shown(show, seen) if report else ()
    source = _source(truth, rules, seen, monitor)
    if background == "auto" and rules.background is not None:
        background = rules.background
    colour = background_of(background, cameras, monitor)
    training = TrainingViews.of(scene, cameras, cull_margin, min_seen)
    facts = _facts(scene, cameras, seen, source) | {
        "options": {"quality": quality, "rate_reference": rate_reference or "pose"} | out.facts(show),
        "cull_margin": cull_margin if math.isfinite(cull_margin) else None,
    }
    with processor(threads):
        frames = len(seen) * len(recipes) * len(scales)
        drawing = rasterizer_of(rasterizer, frames, memory, monitor)
        candidates = candidates_of(scene, training, recipes, drawing, colour)
        against = Truth(own_look(scene, training, drawing, colour), source, rules)
        task = Task(candidates, scales, seen, against, metrics)
        with monitor.progress(f"evaluating {name}", "views") as tell:
            found = measure(task, facts, tell, out.journal, resume, out.images(shown))
    out.write(found, name, scene, training, shown, monitor)
    return found


@dataclass(frozen=True)
class Output:
    """Where an evaluation goes.  folder: None writes nothing."""

    folder: Path | None
    report: bool = False
    layout: str = "plain"
    resume: bool = False
    overwrite: bool = False

    def check(self) -> None:
        """Refuse, before any work, what cannot be written.

        Raises:
            UsageError: what was asked for needs a folder, or contradicts itself.
            OutputError: the folder holds results that may not be replaced.
        """
        if self.layout not in ("plain", "inria"):
            raise UsageError("layout", f"'{self.layout}' is not one of plain, inria")
        needs = {"report": self.report, "layout": self.layout != "plain", "resume": self.resume}
        for parameter in (parameter for parameter, given in needs.items() if given):
            if self.folder is None:
                raise UsageError(parameter, "needs a folder; give `output`")
        if self.resume and self.overwrite:
            raise UsageError("resume", "and `overwrite` contradict each other; give one")
        if self.folder is None or self.replaces:
            return
        if (self.folder / JOURNAL).exists():
            problem = "holds an evaluation; `resume` continues it, `overwrite` starts anew"
            raise OutputError(self.folder, problem)
        files = (*RESULTS, PAGE) if self.report else RESULTS
        refuse_existing([self.folder / name for name in files], overwrite=False)

    def facts(self, show: str) -> dict[str, Any]:
        """What a journal must agree on, besides the measurements."""
        return {"shown": show if self.report else None, "layout": self.layout}

    @property
    def replaces(self) -> bool:
        """Whether existing results are replaced."""
        return self.overwrite or self.resume

    @property
    def journal(self) -> Path | None:
        """The file that keeps what is finished."""
        return self.folder and self.folder / JOURNAL

    def images(self, shown: tuple[int, ...]) -> ImageStore | None:
        """Where images are stored: those that the report shows, and in INRIA's layout all of them."""
        if self.folder is None:
            return None
        return ImageStore(self.folder, shown, everything=self.layout == "inria")

    def write(
        self,
        report: Report,
        name: str,
        scene: Gaussians,
        training: TrainingViews,
        shown: tuple[int, ...],
        monitor: Monitor,
    ) -> None:
        """Write the results, and the report if it was asked for.

        Raises:
            OutputError: a file cannot be written.
        """
        images = self.images(shown)
        if self.folder is None or images is None:
            return
        written = write_results(report, self.folder, self.replaces, name)
        if self.report:
            bounds = coverage(scene, training, report.scales)
            written += write_page(self.folder, name, report, bounds, images, self.replaces)
        for path in written:
            monitor.say(f"wrote {path}")


def _metrics(
    names: str | Sequence[str] | None, protocol: Protocol, weights: Weights | None
) -> tuple[list[Metric], Protocol]:
    """Metrics by name, and the protocol with the flavours that the names ask for; weights add LPIPS."""
    names = (names,) if isinstance(names, str) else names
    chosen = list(default_metrics(protocol) if names is None else names)
    if weights is not None and not any(metric_option(n).startswith("lpips") for n in chosen):
        chosen.append("lpips")
    parts = [metric_option(name).partition(":") for name in chosen]
    for metric, colon, flavour in parts:
        if colon and flavour not in FLAVOURS.get(metric, ()):
            known = ", ".join(f"{name}:{f}" for name in FLAVOURS for f in FLAVOURS[name])
            raise UsageError("metric", f"'{metric}:{flavour}' is not one of {known}")
    protocol = replace(protocol, **{metric: flavour for metric, _, flavour in parts if flavour})
    files = None if weights is None else (Path(weights[0]), Path(weights[1]))
    return find_metrics([metric for metric, _, _ in parts], protocol, files), protocol


def _recipes(
    names: str | Sequence[str | Recipe], scene: Gaussians, quality: str, rate_reference: str | None, monitor: Monitor
) -> list[Recipe]:
    """The recipes with the user's choices; of "all", those that the scene has everything for."""
    names = [names] if isinstance(names, str) else names
    if ALL not in names:
        recipes = [_recipe(name, quality, rate_reference) for name in names]
        return [suited(recipe, scene) for recipe in recipes]
    fitting = []
    for recipe in (_recipe(name, quality, rate_reference) for name in RECIPES):
        missing = recipe.lacks(scene)
        if missing is None:
            fitting.append(suited(recipe, scene))
        else:
            monitor.say(f"recipe {recipe.name} left out: {missing}")
    return fitting


def _recipe(name: str | Recipe, quality: str, rate_reference: str | None) -> Recipe:
    """A recipe with the user's choices; research recipes keep their own rate reference, which is what they compare."""
    if isinstance(name, Recipe):
        return name
    compares = name in USER_NAMES and isinstance(RECIPES.find(name, "recipe").screen, MatchesRates)
    reference = rate_reference if compares else None
    return find_recipe(name, quality=quality, rate_reference=reference)


def _shown(text: str, views: Sequence[Camera]) -> tuple[int, ...]:
    """Places of the views in the report's viewer: that many, evenly spread, or those named."""
    if text.isdecimal():
        count = min(int(text), len(views))
        return tuple(i * len(views) // count for i in range(count))
    places = {view.name: place for place, view in enumerate(views)}
    unknown = [name for name in text.split(",") if name not in places]
    if unknown:
        raise UsageError("show", f"there is no view '{unknown[0]}' among those evaluated")
    return tuple(places[name] for name in text.split(","))


def _source(truth: str, protocol: Protocol, views: Sequence[Camera], monitor: Monitor) -> TruthSource:
    known: dict[str, TruthSource | None] = {"auto": protocol.truth}
    known |= {name: name for name in get_args(TruthSource)}
    if truth not in known:
        raise UsageError("truth", f"'{truth}' is not one of {', '.join(known)}")
    if chosen := known[truth]:
        return chosen
    source = source_of(views)
    why = "" if source == "photographs" else " (not every view has a photograph)"
    monitor.say(f"truth: {source}{why}")
    return source


def _facts(scene: Gaussians, cameras: CameraSet, views: Sequence[Camera], truth: TruthSource) -> dict[str, Any]:
    """What the numbers depend on besides the request: versions, and hashes of what was read."""
    photos = [view.photo for view in views if view.photo] if truth == "photographs" else []
    origin = scene.origin
    return {
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "platform": f"{platform.system()} {platform.machine()}",
        "scene": {
            "file": origin and Path(origin.path).name,
            "sha256": origin and _sha256([Path(origin.path)]),
            "gaussians": len(scene),
            "convention": scene.convention.name,
            "evidence": origin and origin.evidence,
        },
        "cameras": {
            "notes": list(cameras.notes),
            "sha256": _cameras_sha256(views),
            "training_sha256": _cameras_sha256(cameras.train),
        },
        "photographs": {"count": len(photos), "sha256": _sha256(photos) if photos else None},
    }


def _sha256(paths: Sequence[Path]) -> str:
    """Hash of the files' contents, one after another."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            while block := stream.read(HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _cameras_sha256(views: Sequence[Camera]) -> str:
    """Hash of the views as they were understood: names, sizes, intrinsics and poses."""
    understood = [[v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.cam_from_world.tolist()] for v in views]
    return hashlib.sha256(json.dumps(understood).encode()).hexdigest()
