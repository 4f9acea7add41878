"""aaplug finetune: move the Gaussians until every scale shows what the training size shows."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Convention, Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.report.contact_sheet import contact_sheet
from aaplug.evaluation.results import results, scale_name, tables
from aaplug.finetuning import (
    OURS,
    Candidate,
    Job,
    Settings,
    State,
    Truth,
    find_upsampler,
    mipmap_gs,
)
from aaplug.finetuning.settings import RATES
from aaplug.io.atomic import check_output, replacing
from aaplug.io.images import write_png
from aaplug.io.scenes import check_scene_output, find_scene, write_scene
from aaplug.methods.filters import fuse_stored
from aaplug.methods.recipes import RECIPES, Recipe
from aaplug.methods.viewers import VIEWERS, convert_for
from aaplug.rendering.renderer import render, smooth

from .console import out, print_json, say
from .options import CameraOptions, SceneOptions, ViewOptions, flag
from .tuning import INTERRUPTED, measured, recorded, tune

Target = Literal["fast", "classic-viewer", "antialiased-viewer", "mip-viewer", "gsplat"]
Leaf = Literal["means", "quats", "log_scales", "logit_opacities", "dc", "rest"]


@dataclass(frozen=True)
class Finetune:
    """Move the Gaussians until every scale shows what the training size shows, and write a plain .ply."""

    output: Annotated[Path, flag("FILE.ply", "-o")]
    """Where to write; a report (.finetune.json), pictures (.finetune.png) and the checkpoint go beside it."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    viewing: ViewOptions = field(default_factory=ViewOptions)
    target: Annotated[
        Target | None,
        tyro.conf.arg(name="for", metavar="|".join(get_args(Target)), help_behavior_hint=""),
    ] = None
    """What will show it: aaplug with one sample a pixel (fast, the default), or a viewer with a rule of its own
    (mipmap-gs's default is classic-viewer)."""
    method: Literal["consistency", "mipmap-gs"] = "consistency"
    """consistency is one model for all scales; mipmap-gs is one for the one --scale given, as Mipmap-GS makes it."""
    scale: tuple[float, ...] = tuple(OURS.weights)
    """Sizes against training's that must look right, beside the training size itself."""
    steps: Annotated[int | None, flag("N")] = None
    """Steps (default: 1000)."""
    loss: Literal["l2", "l1-dssim"] = "l2"
    """l2, or 3DGS's 0.8 L1 + 0.2 D-SSIM."""
    anchor: float = OURS.anchor
    """Weight of the training size in every step, against 1 for the other scales."""
    move: Annotated[tuple[Leaf, ...], tyro.conf.arg(metavar="|".join(RATES))] = get_args(Leaf)
    """Which parameters move."""
    rate: float = 1.0
    """Learning rates against the method's own."""
    densify_every: Annotated[int | None, flag("N")] = None
    """Clone, split and prune every N steps; 0 for never (default: the method's own)."""
    truth: Literal["auto", "self", "photographs"] = "auto"
    """What the training size shows: the scene's own render, or photographs; auto takes those where all exist."""
    upsampler: Annotated[str | None, flag("bicubic|lanczos|FILE")] = None
    """For scales above 1 without photographs that large: an interpolation, or a network's weights (ESPCN_x4.pb, a
    torch.export .pt2); default: the scene's own render there, corrected to the training size's averages."""
    seed: int = 0
    """Of what the steps draw."""
    checkpoint_every: Annotated[int, flag("N")] = 100
    """Steps between checkpoints."""
    resume: bool = False
    """Go on from the checkpoint of an interrupted run."""
    overwrite: bool = False
    """Replace existing outputs."""
    json: bool = False
    """Print the report on stdout as JSON instead of the table."""


def finetune(options: Finetune) -> int:
    """Move the Gaussians until every scale shows what the training size shows."""
    files = _files(options)
    settings = settings_of(options)
    scene = options.scene.read()
    cameras = options.cameras.read(options.scene)
    background = options.viewing.background_of(cameras)
    training = options.cameras.learn(scene, cameras)
    rasterizer = options.viewing.rasterize(settings.steps)
    truth = _truth(options, scene, cameras, training, rasterizer, background)
    target = options.target or ("fast" if options.method == "consistency" else "classic-viewer")
    start, recipe, convention = _target(target, scene, training)
    job = Job(start, training, recipe, cameras.train, truth, settings, rasterizer, background)
    say(
        f"tuning for {recipe.name} ({recipe.source}): {settings.name}, {settings.steps} steps, "
        f"truth: {'photographs' if truth.photographs else 'the own training-size render'}"
    )
    state, done = tune(job, files.checkpoint, options.checkpoint_every, options.resume)
    if not done:
        say(f"stopped at step {state.step}; go on with the same command and --resume")
        return INTERRUPTED
    tuned = recorded(state, job, convention, {"for": target, "method": settings.name})
    axes = options.scene.spz_axes
    write_scene(files.scene, tuned, overwrite=options.overwrite, spz_axes=axes)
    _report(options, files, job, state, scene, tuned, options.viewing.select(cameras))
    files.checkpoint.unlink(missing_ok=True)
    say(f"wrote {files.scene}, {files.report.name} and {files.pictures.name}")
    return 0


@dataclass(frozen=True)
class _Files:
    """What a run writes."""

    scene: Path
    report: Path
    pictures: Path
    checkpoint: Path


def _files(options: Finetune) -> _Files:
    """The outputs, none of which may stand there already."""
    source = find_scene(options.scene.path, options.scene.iteration)
    files = _Files(
        options.output,
        *(options.output.with_suffix(f".finetune.{kind}") for kind in ("json", "png", "pt")),
    )
    check_scene_output(files.scene, options.overwrite, [source])
    for path in (files.report, files.pictures):
        check_output(path, options.overwrite, [source])
    check_output(files.checkpoint, options.resume or options.overwrite, [source])
    return files


def _report(
    options: Finetune,
    files: _Files,
    job: Job,
    state: State,
    scene: Gaussians,
    tuned: Gaussians,
    views: Sequence[Camera],
) -> None:
    """Measure before and after, and write and print what was found."""
    candidates = [Candidate("before", scene, job.recipe), Candidate("after", tuned, job.recipe)]
    if len(job.start.fused) > len(scene.fused):
        candidates.insert(1, Candidate("closed form", job.start, job.recipe))
    truth = replace(job.truth, photographs=all(view.photo for view in views))
    scales = sorted({1.0, *job.settings.weights}, reverse=True)
    report = measured(candidates, views, scales, truth)
    found = results(report) | {"settings": _facts(job.settings), "probes": state.probes}
    with replacing(files.report, options.overwrite) as stream:
        stream.write(json.dumps(found | {"curve": state.curve}, indent=1).encode())
    sheet = _sheet(candidates, views[0], scales, truth)
    write_png(files.pictures, sheet, overwrite=options.overwrite)
    if options.json:
        print_json(found)
    else:
        out.print(*tables(report))


def settings_of(options: Finetune) -> Settings:
    """The method's settings with what the user chose.

    Raises:
        UsageError: an option is out of its range, or does not fit the method.
    """
    for name, value in (("--steps", options.steps), ("--densify-every", options.densify_every)):
        if value is not None and value < 0:
            raise UsageError(name, f"must be 0 or more, got {value}")
    if options.checkpoint_every < 1:
        raise UsageError("--checkpoint-every", f"must be 1 or more, got {options.checkpoint_every}")
    if not (options.scale and all(0 < scale < math.inf for scale in options.scale)):
        raise UsageError("--scale", "needs sizes above 0")
    if not (options.rate > 0 and options.anchor >= 0 and options.move):
        raise UsageError(
            "--rate, --anchor, --move",
            "need a rate above 0, an anchor of 0 or more, and a parameter",
        )
    if options.method == "mipmap-gs":
        if len(options.scale) != 1:
            raise UsageError("--scale", "mipmap-gs makes one model for one scale; give one")
        settings = mipmap_gs(options.scale[0])
    else:
        weights = {scale: OURS.weights.get(scale, 1.0) for scale in options.scale}
        rates = {leaf: RATES[leaf] for leaf in options.move}
        settings = replace(OURS, weights=weights, rates=rates, anchor=options.anchor)
    rates = {leaf: rate * options.rate for leaf, rate in settings.rates.items()}
    return replace(
        settings,
        steps=settings.steps if options.steps is None else options.steps,
        rates=rates,
        loss=options.loss,
        seed=options.seed,
        densify_every=settings.densify_every
        if options.densify_every is None
        else options.densify_every,
    )


def _truth(
    options: Finetune,
    scene: Gaussians,
    cameras: CameraSet,
    training: TrainingViews,
    rasterizer: Rasterizer,
    background: tuple[float, float, float],
) -> Truth:
    """What renders are compared with."""
    missing = [view.name for view in cameras.train if view.photo is None]
    if options.truth == "photographs" and missing:
        raise UsageError(missing[0], "has no photograph; --truth self needs none")
    photographs = options.truth == "photographs" or (options.truth == "auto" and not missing)
    upsample = None if options.upsampler is None else find_upsampler(options.upsampler)
    return Truth(scene, training, rasterizer, background, photographs, upsample)


def _target(
    target: str, scene: Gaussians, training: TrainingViews
) -> tuple[Gaussians, Recipe, Convention]:
    """The scene to start from, the rule that will show it, and the convention that the file names."""
    if target == "fast":
        return fuse_stored(scene), RECIPES["matched"], scene.convention
    viewer = VIEWERS[target]
    start = convert_for(scene, training, viewer)
    return start, RECIPES[viewer.recipe], viewer.convention


def _facts(settings: Settings) -> dict[str, Any]:
    """Settings as JSON has them."""
    weights = {f"{scale:g}": weight for scale, weight in settings.weights.items()}
    return asdict(settings) | {"weights": weights}


def _sheet(
    candidates: Sequence[Candidate], view: Camera, scales: Sequence[float], truth: Truth
) -> Any:
    """One view at every scale: as it should be, and by each candidate."""
    rows = []
    for scale in scales:
        camera = view.scaled(scale)
        images = [truth(view, scale)] + [
            render(
                smooth(c.scene, truth.training, c.recipe),
                camera,
                c.recipe,
                truth.training,
                truth.rasterizer,
                truth.background,
            ).rgb
            for c in candidates
        ]
        rows.append((f"{scale_name(scale)}: {camera.width}x{camera.height}", images))
    return contact_sheet(("truth", *(c.name for c in candidates)), rows)
