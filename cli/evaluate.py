"""aaplug evaluate: every recipe at every scale, measured."""

import hashlib
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import OutputError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Task
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import Images
from aaplug.evaluation.lpips import lpips_metric
from aaplug.evaluation.metrics import CONSISTENCY, ENERGY, FLICKER, FLIP, PSNR, SSIM, Metric
from aaplug.evaluation.protocols import PROTOCOLS, Protocol, Truth, find_protocol
from aaplug.evaluation.results import Report, as_csv, per_view, results, tables
from aaplug.inspection.coverage import coverage
from aaplug.io.atomic import replacing
from aaplug.methods.recipes import RECIPES, Recipe, lacking, suited

from .batch import Job, finish_batch, jobs_of, run_batch
from .console import out, print_json, progress, say
from aaplug.io.folders import make_folder, refuse_existing
from .options import CameraOptions, RenderOptions, SceneOptions, flag

HASH_BLOCK = 1 << 20  # bytes read at once
RECORD = "progress.jsonl"
FILES = ("results.json", "per_view.json", "results.csv")


@dataclass(frozen=True)
class OtherScenes:
    """More scenes."""

    more: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("[SCENE ...]")] = ()
    """More scenes, with the same --cameras or each a model folder; their results go to folders of their own."""


@dataclass(frozen=True)
class Evaluate:
    """Measure recipes over scales, against photographs or against the scene's own look; of many scenes in one go."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    others: OtherScenes = field(default_factory=OtherScenes)
    batch: Annotated[Path | None, flag("FILE.toml")] = None
    """Scenes and their settings from a file; what it does not say is as on the command line."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for results.json, per_view.json and results.csv."""
    protocol: Annotated[str, tyro.conf.arg(metavar="|".join(PROTOCOLS))] = "default"
    """Scales, truth, downscaling and flavours of metrics, by name."""
    recipe: Annotated[tuple[str, ...], tyro.conf.arg(metavar="|".join([*RECIPES, "all"]))] = (
        "classic",
        "mip",
        "matched",
        "auto",
    )
    """One or more recipes, or all."""
    scale: Annotated[tuple[float, ...] | None, flag("FACTOR [FACTOR ...]")] = None
    """One or more sizes against the training size, on either side of 1 (default: the protocol's)."""
    truth: Literal["auto", "photographs", "self"] = "auto"
    """Compare with photographs, or with the scene's own supersampled look; auto leaves it to the protocol."""
    ssim: Annotated[Literal["wang", "3dgs"] | None, flag("wang|3dgs")] = None
    """SSIM with the border cropped (scikit-image) or zero-padded (3DGS) (default: the protocol's)."""
    lpips: Annotated[tuple[Path, Path] | None, flag("TRUNK HEADS")] = None
    """Measure LPIPS with these weights: torchvision's VGG16 (AlexNet), and the lpips package's heads for it."""
    lpips_flavour: Annotated[Literal["3dgs", "vgg", "alex"] | None, flag("3dgs|vgg|alex")] = None
    """VGG fed [0, 1] as 3DGS does, or VGG or AlexNet fed [-1, 1] (default: the protocol's)."""
    flip: bool = False
    """Measure FLIP (needs flip-evaluator)."""
    flicker: bool = False
    """Measure flicker under sub-pixel motion, which renders every image four times."""
    report: bool = False
    """Write report.html, one page with tables, curves and a before/after viewer, and its plots."""
    show: Annotated[str, tyro.conf.arg(metavar="N|NAME,...")] = "3"
    """Views in the report's viewer: how many, or which."""
    layout: Literal["plain", "inria"] = "plain"
    """inria stores every render and its truth in test/METHOD/{renders,gt}, where other metric scripts look."""
    resume: bool = False
    """Continue an evaluation that was interrupted; what it had finished is not done again."""
    overwrite: bool = False
    """Replace existing results."""
    json: bool = False
    """Print results.json on stdout instead of the table."""


def evaluate(options: Evaluate) -> int:
    """Measure recipes over scales."""
    jobs = jobs_of(options)
    for job in jobs:
        _check_output(job.options)
    if not jobs[0].alone:
        reports, failures = run_batch(jobs, _run)
        return finish_batch(options, jobs, reports, failures)
    report = _run(jobs[0])
    if options.json:
        print_json(results(report))
    else:
        out.print(*tables(report))
    return 0


def _check_output(options: Evaluate) -> None:
    """Refuse what cannot be written, before any work."""
    if options.output is None:
        needing = {"--report": options.report, "--layout inria": options.layout == "inria"}
        needing["--resume"] = options.resume
        for name in (name for name, given in needing.items() if given):
            raise UsageError(name, "needs a folder: -o FOLDER")
        return
    if options.resume and options.overwrite:
        raise UsageError("--resume and --overwrite", "contradict each other; give one")
    if (options.output / RECORD).exists() and not (options.resume or options.overwrite):
        raise OutputError(
            options.output, "holds an evaluation; --resume continues it, --overwrite starts anew"
        )
    files = (*FILES, *(("report.html",) if options.report else ()))
    refuse_existing([options.output / name for name in files], options.overwrite or options.resume)


def _run(job: Job) -> Report:
    """Evaluate one scene and write what was found."""
    options = job.options
    protocol = _protocol(options)
    recipes = options.rendering.recipes(RECIPES if "all" in options.recipe else options.recipe)
    judges = _judges(options, protocol)
    scene = options.scene.read()
    if "all" in options.recipe:
        recipes = _drawable(recipes, scene)
    recipes = [suited(recipe, scene) for recipe in recipes]
    cameras = options.cameras.read(options.scene)
    views = options.rendering.select(cameras)
    shown = _shown(options.show, views) if options.report else ()
    truth = _truth(options, protocol, views)
    background = _background(options, protocol, cameras)
    training = options.cameras.learn(scene, cameras)
    scales = options.scale or protocol.scales
    rasterizer = options.rendering.rasterize(len(views) * len(recipes) * len(scales))
    figures = (CONSISTENCY, ENERGY) if protocol.change == "size" else ()
    figures += (FLICKER,) if options.flicker and protocol.change == "size" else ()
    task = Task(recipes, scales, views, background, truth, rasterizer, protocol, judges, figures)
    facts = _facts(options, scene, cameras, views, truth)
    folder = options.output
    with progress(f"evaluating{'' if job.alone else ' ' + job.name}", "views") as tell:
        report = measure(
            scene,
            training,
            task,
            facts,
            tell,
            record=folder and folder / RECORD,
            resume=options.resume,
            images=_images(options, shown),
        )
    if folder is not None:
        write_results(report, folder, options.overwrite or options.resume, job.name)
        if options.report:
            _write_page(options, job.name, report, scene, training, shown)
    return report


def _protocol(options: Evaluate) -> Protocol:
    protocol = find_protocol(options.protocol)
    return replace(
        protocol,
        ssim=options.ssim or protocol.ssim,
        lpips=options.lpips_flavour or protocol.lpips,
    )


def _drawable(recipes: Sequence[Recipe], scene: Gaussians) -> list[Recipe]:
    """The recipes that the scene has everything for; says which are left out, and why."""
    missing = {recipe.name: lacking(recipe, scene) for recipe in recipes}
    for name, words in missing.items():
        if words is not None:
            say(f"recipe {name} left out: {words}")
    return [recipe for recipe in recipes if missing[recipe.name] is None]


def _judges(options: Evaluate, protocol: Protocol) -> list[Metric]:
    judges = [PSNR, SSIM[protocol.ssim]]
    if options.lpips is not None:
        judges.append(lpips_metric(protocol.lpips, *options.lpips))
    elif options.lpips_flavour is not None:
        raise UsageError("--lpips-flavour", "needs weights: --lpips TRUNK HEADS")
    return judges + [FLIP] * options.flip


def _shown(text: str, views: Sequence[Camera]) -> tuple[int, ...]:
    """Places of the views in the report's viewer: that many, evenly spread, or those named."""
    if text.isdecimal():
        count = min(int(text), len(views))
        return tuple(i * len(views) // count for i in range(count))
    places = {view.name: place for place, view in enumerate(views)}
    unknown = [name for name in text.split(",") if name not in places]
    if unknown:
        raise UsageError("--show", f"there is no view '{unknown[0]}' among those evaluated")
    return tuple(places[name] for name in text.split(","))


def _background(
    options: Evaluate, protocol: Protocol, cameras: CameraSet
) -> tuple[float, float, float]:
    if options.rendering.background == "auto" and protocol.background is not None:
        return protocol.background
    return options.rendering.background_of(cameras)


def _images(options: Evaluate, shown: tuple[int, ...]) -> Images | None:
    """Where images are stored: all of them in INRIA's layout, those that the report shows beside it."""
    if options.output is None:
        return None
    return Images(options.output, shown, everything=options.layout == "inria")


def _write_page(
    options: Evaluate,
    name: str,
    report: Report,
    scene: Gaussians,
    training: TrainingViews,
    shown: tuple[int, ...],
) -> None:
    from aaplug.evaluation.report.webpage import write_page  # matplotlib takes most of a second

    assert options.output is not None
    images = _images(options, shown)
    assert images is not None
    found = coverage(scene, training, report.scales)
    written = write_page(
        options.output, name, report, found, images, options.overwrite or options.resume
    )
    for path in written:
        say(f"wrote {path}")


def write_results(report: Report, folder: Path, overwrite: bool, name: str = "scene") -> None:
    """Write results.json, per_view.json and results.csv into a folder."""
    make_folder(folder)
    texts = [
        *(
            json.dumps(data, indent=1, allow_nan=False) + "\n"
            for data in (results(report), per_view(report))
        ),
        as_csv({name: report}),
    ]
    for file, text in zip(FILES, texts, strict=True):
        with replacing(folder / file, overwrite) as stream:
            stream.write(text.encode())
        say(f"wrote {folder / file}")


def _truth(options: Evaluate, protocol: Protocol, views: Sequence[Camera]) -> Truth:
    if options.truth != "auto":
        return options.truth
    if protocol.truth is not None:
        return protocol.truth
    truth = "photographs" if all(view.photo for view in views) else "self"
    say(
        f"truth: {truth}" + ("" if truth == "photographs" else " (not every view has a photograph)")
    )
    return truth


def _facts(
    options: Evaluate, scene: Gaussians, cameras: CameraSet, views: Sequence[Camera], truth: str
) -> dict[str, Any]:
    """What the numbers depend on: versions, options, what was read and its hashes."""
    assert scene.origin is not None
    packages = ("aaplug", "torch", "numpy", "scikit-image", "opencv-contrib-python-headless")
    photos = [view.photo for view in views if view.photo] if truth == "photographs" else []
    guard, path = options.cameras.guard, Path(scene.origin.path)
    return {
        "versions": {name: version(name) for name in packages}
        | {"python": platform.python_version()},
        "platform": f"{platform.system()} {platform.machine()}",
        "scene": {
            "file": path.name,
            "sha256": _sha256([path]),
            "gaussians": len(scene),
            "convention": scene.convention.name,
            "evidence": scene.origin.evidence,
        },
        "cameras": {
            "notes": list(cameras.notes),
            "sha256": _cameras_sha256(views),
            "training_sha256": _cameras_sha256(cameras.train),
        },
        "photographs": {"count": len(photos), "sha256": _sha256(photos) if photos else None},
        "options": {
            "quality": options.rendering.quality,
            "rate": options.rendering.rate or "pose",
            "shown": options.show if options.report else None,
            "layout": options.layout,
        },
        "guard": guard if math.isfinite(guard) else None,
    }


def _sha256(paths: list[Path]) -> str:
    """Hash of the files' contents, one after another."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            while block := stream.read(HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _cameras_sha256(views: Sequence[Camera]) -> str:
    """Hash of the views as they were understood: names, sizes, intrinsics, poses."""
    understood = [
        [v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.cam_from_world.tolist()]
        for v in views
    ]
    return hashlib.sha256(json.dumps(understood).encode()).hexdigest()
