"""aaplug convert: a plain .ply with anti-aliasing fused in."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import Report, mean, results, tables
from aaplug.finetuning import QUICK, Candidate, Job, Truth, balanced, between
from aaplug.io.scenes import check_scene_output, find_scene, write_parts, write_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.filters import fuse_stored
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import FORMS, VIEWERS, Viewer, convert_for, default_form, describe
from aaplug.methods.viewers import convert as fuse
from aaplug.verbs.in_parts import LARGE, check_frame_of, convert_parts

from .console import out, print_json, progress, say
from .options import CameraOptions, SceneOptions, ViewOptions, flag
from .tuning import INTERRUPTED, measured, recorded, spread, tune

SHARES = (
    0.5,
    0.25,
    0.125,
)  # of the way to the tuned scene, where that is worse than the original at some scale
ROUNDING = (1 / 255) ** 2 / 12  # mean square error of rounding to 8 bits
JUDGED = 8  # training views, evenly spread, that the residual is measured on


@dataclass(frozen=True)
class Convert:
    """Fuse anti-aliasing into a plain .ply, for viewers with the 2D Mip filter (0.1 px², compensated) or another."""

    output: Annotated[Path, flag("FILE", "-o")]
    """Where to write: .ply, or .spz and .splat, which round values and keep less."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    viewing: ViewOptions = field(default_factory=lambda: ViewOptions(views="train"))
    target: Annotated[
        Literal["classic-viewer", "antialiased-viewer", "mip-viewer", "gsplat"] | None,
        tyro.conf.arg(name="for", metavar="|".join(VIEWERS), help_behavior_hint=""),
    ] = None
    """Fit the scene to what a viewer does, from the closed form by a short optimization, and print what is left."""
    steps: Annotated[int | None, flag("N")] = None
    """Steps of that optimization (default: 300, none for a viewer that shows what training showed); 0 keeps the closed
    form."""
    form: Annotated[
        Literal["matched-energy", "mip-splatting"] | None, flag("matched-energy|mip-splatting")
    ] = None
    """Without --for, what to fuse: the energy that training showed, or Mip-Splatting's 3D smoothing (default for
    filter_3D files)."""
    variance: Annotated[float | None, flag("PX2")] = None
    """Without --for, variance fused, in px² at the training rate (default: 0.2 for both forms)."""
    overwrite: bool = False
    """Replace an existing output."""
    json: bool = False
    """Print what was done as one JSON object on stdout."""


def convert(options: Convert) -> int:
    """Fuse anti-aliasing into a plain .ply."""
    source = find_scene(options.scene.path, options.scene.iteration)
    check_scene_output(options.output, options.overwrite, [source])
    _check(options)
    opened = options.scene.open()
    if opened.count > LARGE and options.target is None:
        return _convert_in_parts(options, opened)
    scene = opened.whole(options.scene.drop_bad)
    if options.target is not None:
        return _fitted(options, scene, options.target)
    form = FORMS[options.form or default_form(scene)]
    if options.variance is not None:
        form = replace(form, variance=options.variance)  # type: ignore[type-var]
    stored = scene.filter_3d is not None or bool(scene.fused)  # either needs no cameras
    training = None
    if not stored:
        training = options.cameras.learn(scene, options.cameras.read(options.scene))
    converted = fuse(scene, training, form)
    _write(options, converted)
    done = "; ".join(describe(fusion) for fusion in converted.fused)
    say(f"wrote {options.output}: fused {done}; show it with the Mip rule (0.1 px², compensated)")
    if options.json:
        print_json(_facts(options, converted))
    return 0


def _convert_in_parts(options: Convert, opened: SceneFile) -> int:
    """The same for a scene that would need much memory whole."""
    first = opened.raw(0, min(1, opened.count))
    form = FORMS[options.form or default_form(first)]
    if options.variance is not None:
        form = replace(form, variance=options.variance)  # type: ignore[type-var]
    cameras = ()
    if first.filter_3d is None and not opened.fused:
        cameras = options.cameras.read(options.scene).train
        check_frame_of(opened, cameras, options.cameras.min_seen)
    with progress("converting", "Gaussians") as tell:
        parts = convert_parts(
            opened,
            cameras,
            form,
            options.cameras.guard,
            options.scene.drop_bad,
            tell,
            threads=torch.get_num_threads(),
        )
        write_parts(
            options.output,
            parts,
            opened.count,
            [opened.path],
            overwrite=options.overwrite,
            spz_axes=options.scene.spz_axes,
        )
    say(f"wrote {options.output}, in parts; show it with the Mip rule (0.1 px², compensated)")
    if options.json:
        print_json({"output": str(options.output), "gaussians": opened.count})
    return 0


def _check(options: Convert) -> None:
    if options.target is None and options.steps is not None:
        raise UsageError("--steps", "is of the optimization of --for; name a viewer")
    if options.target is not None and (options.form or options.variance is not None):
        raise UsageError("--for", "chooses form and variance itself; leave out --form, --variance")
    if options.steps is not None and options.steps < 0:
        raise UsageError("--steps", f"must be 0 or more, got {options.steps}")


def _fitted(options: Convert, scene: Gaussians, target: str) -> int:
    """Convert for a viewer: the closed form, or the original where that is not better, some steps, what is left."""
    viewer = VIEWERS[target]
    cameras = options.cameras.read(options.scene)
    background = options.viewing.background_of(cameras)
    training = options.cameras.learn(scene, cameras)
    start, recipe = convert_for(scene, training, viewer), RECIPES[viewer.recipe]
    settings = replace(QUICK, steps=_steps(options, scene, viewer))
    rasterizer = options.viewing.rasterize(settings.steps)
    truth = Truth(scene, training, rasterizer, background)
    views, scales = spread(options.viewing.select(cameras), JUDGED), (1.0, *settings.weights)
    before = measured(
        [Candidate("original", scene, recipe), Candidate("closed form", start, recipe)],
        views,
        scales,
        truth,
    )
    settings = balanced(settings, _errors(before))
    if settings.steps and _worse(before, "closed form"):
        say("the closed form is worse than the original at some scale: starting from the original")
        start = fuse_stored(scene)
    job = Job(start, training, recipe, cameras.train, truth, settings, rasterizer, background)
    state, done = tune(job)
    if not done:
        say("stopped; nothing is written")
        return INTERRUPTED
    tuned = converted = recorded(state, job, viewer.convention, {"for": target})
    _write(options, converted)

    def judge(found: Gaussians) -> Report:
        return before.with_more(
            measured([Candidate("converted", found, recipe)], views, scales, truth)
        )

    report = judge(converted)
    for share in SHARES if state.step else ():
        if not _worse(report, "converted"):
            break
        say(f"worse than the original at some scale: {share:g} of the way from it instead")
        converted = _partly(scene, tuned, share)
        _write(replace(options, overwrite=True), converted)
        report = judge(converted)
    if state.step and _worse(report, "converted"):
        say("still worse than the original at some scale: read the table before you use the file")
    fused = "; ".join(describe(fusion) for fusion in converted.fused) or "nothing"
    if options.json:
        print_json(_facts(options, converted) | {"for": target, "residual": results(report)})
    else:
        _print(report)
    say(f"wrote {options.output}: fused {fused}; show it with {viewer.rule}")
    return 0


def _steps(options: Convert, scene: Gaussians, viewer: Viewer) -> int:
    """Those asked for; else the usual number, or none for a viewer that shows what training showed."""
    if options.steps is not None:
        return options.steps
    if scene.convention != viewer.convention:
        return QUICK.steps
    say(f"the scene was trained for this rule ({viewer.rule}): there is nothing to fit")
    return 0


def _errors(report: Report) -> dict[float, float]:
    """The original's mean square error by scale, no less than the rounding of the images compared."""
    decibels = {s: mean(report.select("original", s), PSNR.name) for s in report.scales}
    return {s: max(ROUNDING, 0.0 if d is None else 10 ** (-d / 10)) for s, d in decibels.items()}


def _write(options: Convert, scene: Gaussians) -> None:
    axes = options.scene.spz_axes
    write_scene(options.output, scene, overwrite=options.overwrite, spz_axes=axes)


def _partly(scene: Gaussians, tuned: Gaussians, share: float) -> Gaussians:
    """A share of the way from the original to the tuned scene, which the record of the tuning tells."""
    *earlier, tuning = tuned.fused
    partly = Fusion(tuning.method, tuning.settings | {"share": f"{share:g}"})
    return replace(between(fuse_stored(scene), tuned, share), fused=(*earlier, partly))


def _worse(report: Report, name: str) -> bool:
    """Whether a candidate is below the original at any scale."""
    for scale in report.scales:
        names = ("original", name)
        before, after = (mean(report.select(name, scale), PSNR.name) for name in names)
        if after is not None and (before is None or after < before):  # None is equal to the truth
            return True
    return False


def _print(report: Report) -> None:
    out.print("By the viewer's rule, against the scene's own training-size render:")
    out.print(tables(report)[0])


def _facts(options: Convert, converted: Gaussians) -> dict[str, Any]:
    fused = [{"method": f.method, **f.settings} for f in converted.fused]
    return {"output": str(options.output), "gaussians": len(converted), "fused": fused}
