"""The table of verbs: the options of each, and how it reads, calls the library and tells what came of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import aaplug
from aaplug.options import verbs
from aaplug.options.base import REPORT, Options, flag, names, number
from aaplug.options.shared import MAX_SIDE, RECIPE_METAVAR, FrameOptions, Orbit
from aaplug.system.errors import UsageError, printable

from .batch import SEVERAL, batch_of_evaluations, for_each_scene, made_before
from .console import FAILED, TERMINAL, print_json, say, show, show_rows
from .inputs import (
    SCENE_AND_CAMERAS,
    CameraOptions,
    FileOptions,
    SceneOptions,
    open_scene,
    path_of,
    read_cameras,
    read_inputs,
    told,
)
from .words import VERBS, Command, Option, Words, json_of, output

if TYPE_CHECKING:
    from aaplug.rendering.benchmark import Figures

PROGRAM_KEYS = ("fused", "comments")  # of `info`, for programs; the table has words for the first


def verb(*options: type[Options] | Option) -> Callable[[Callable[[Words], int]], Callable[[Words], int]]:
    """Enter a function into the table with its options; its docstring is the verb's help."""

    def enter(run: Callable[[Words], int]) -> Callable[[Words], int]:
        name = run.__name__.replace("_", "-")
        VERBS[name] = Command(name, cleandoc(run.__doc__ or ""), options, run)
        return run

    return enter


@verb(
    *SCENE_AND_CAMERAS,
    output("PATH", "A folder for the images, or one .png for one view."),
    verbs.RenderOptions,
    json_of("the files as one JSON object"),
)
def render(words: Words) -> int:
    """Render views of a scene at any size to PNG.

    To measure how close images come to the truth, use evaluate; for a moving camera, video.
    """
    inputs = read_inputs(words)
    written = aaplug.render(*inputs, words.output, **told(words, verbs.RenderOptions))
    if words.json:
        images = [{"view": v.name, "file": str(p), "width": v.width, "height": v.height} for v, p in written]
        print_json({"recipe": words.recipe, "images": images})
    else:
        say(f"wrote {len(written)} image{'s' * (len(written) != 1)} to {words.output}")
    return 0


@verb(
    *SCENE_AND_CAMERAS,
    output("FILE", "File to write: .ply, or .spz or .splat, which round values and keep less; with --batch, a folder."),
    verbs.ConvertOptions,
    *SEVERAL,
    json_of("what was done as one JSON object"),
)
def convert(words: Words) -> int:
    """Fuse anti-aliasing into a plain scene file of as many Gaussians, for viewers with a fixed 2D filter.

    In seconds for the 2D Mip filter (0.1 px², compensated), in minutes for a viewer named by --for.  For fewer
    Gaussians, use lod; to move the Gaussians until all sizes look right, finetune.
    """
    if words.batch is not None:
        return for_each_scene(words, lambda own: ".ply", _converted_facts)
    facts, result = _converted(words)
    from aaplug.evaluation.results import tables
    from aaplug.methods.conversion import fused_in

    if words.json:
        print_json(facts)
    elif result.report is not None:
        show("As the viewer draws it, against the scene's own training-size render:")
        show(tables(result.report)[0])
    how = "in parts" if result.scene is None else f"fused {fused_in(result.scene)}"
    say(f"wrote {words.output}: {how}; show it with {result.viewer.rule} ({result.viewer.name})")
    say(result.viewer.advice(words.output.suffix[1:].lower()))
    return 0


def _converted(words: Words) -> tuple[dict[str, Any], Any]:
    """Convert one scene; facts for JSON, and the result."""
    inputs = read_inputs(words)
    result = aaplug.convert(*inputs, words.output, **told(words, verbs.ConvertOptions))
    return {"output": str(words.output)} | result.as_json(), result


def _converted_facts(words: Words) -> dict[str, Any]:
    return _converted(words)[0]


@verb(
    *SCENE_AND_CAMERAS,
    output("PATH", "The one scene's file (.ply, .spz or .splat), or a folder for levels (.ply) or, with --batch, all."),
    verbs.LodOptions,
    *SEVERAL,
    json_of("what was made as one JSON object"),
)
def lod(words: Words) -> int:
    """Merge Gaussians: into levels of detail, or into one lighter scene (--simplify, --budget).

    Levels make small images faster and cleaner.  To keep every Gaussian, use convert or finetune.
    """
    if words.batch is not None:
        work = partial(_lod_of_batch, resume=words.resume)
        return for_each_scene(words, lambda own: ".ply" if own.of(verbs.LodOptions).single else "", work)
    facts = _lod(words)
    if words.json:
        print_json(facts)
    counts = [f"{level['gaussians']:,}" for level in facts["levels"]]
    say(f"wrote {words.output}: {' > '.join(counts)} Gaussians")
    return 0


def _lod(words: Words) -> dict[str, Any]:
    scene, cameras = read_inputs(words)
    levels = aaplug.lod(scene, cameras, words.output, **told(words, verbs.LodOptions))
    made = [{"rate": level.rate, "gaussians": len(level.scene)} for level in levels]
    return {"output": str(words.output), "gaussians": scene.count, "levels": made}


def _lod_of_batch(own: Words, resume: bool) -> dict[str, Any]:
    """One scene of a batch; `resume` leaves out levels that are there."""
    from aaplug.io.scenes.pyramid_folder import is_pyramid, read_manifest
    from aaplug.verbs.lod import DEFAULT_LEVELS

    resume = resume and is_pyramid(own.output)
    if resume and len(read_manifest(own.output, unfinished=True).levels) > (own.levels or DEFAULT_LEVELS):
        return made_before(own)
    return _lod(own.where(resume=resume))


@verb(
    *SCENE_AND_CAMERAS,
    output("FILE.ply", "File to write the scene to."),
    verbs.FinetuneOptions,
    json_of("the report as JSON instead of the table"),
)
def finetune(words: Words) -> int:
    """Optimize the Gaussians until every scale looks like the training size, averaged down; write a plain scene file.

    It takes minutes to hours and gives the closest images at one sample per pixel; convert takes seconds.  A report
    (.finetune.json), pictures (.finetune.png) and a checkpoint go beside it.  Ctrl-C stops after the current step;
    --resume continues.
    """
    inputs = read_inputs(words)
    tuned = aaplug.finetune(*inputs, words.output, **told(words, verbs.FinetuneOptions))
    if words.json:
        print_json(tuned.as_json())
    else:
        from aaplug.evaluation.results import tables

        show(*tables(tuned.report))
    stem = words.output.stem
    say(f"wrote {words.output}, {stem}.finetune.json and {stem}.finetune.png")
    return 0


MORE_SCENES = Option(
    "more",
    flag("[SCENE ...]", read=Path, by_place=True, count=None),
    "More scenes, with the same --cameras or each a model folder.  Each gets its own folder of results.",
    (),
)
BATCH = Option(
    "batch",
    flag("FILE.toml", read=Path),
    "Scenes and their settings from a file; what it does not say is as on the command line.",
    None,
)


@verb(
    SceneOptions,
    MORE_SCENES,
    BATCH,
    CameraOptions,
    Orbit,
    output("FOLDER", "Folder for results.json, per_view.json and results.csv.", None),
    verbs.EvaluateOptions,
    json_of("results.json instead of the table"),
)
def evaluate(words: Words) -> int:
    """Measure recipes over scales, against photographs or against the scene's own look; of one scene or many.

    To measure scene files against each other, use compare; for images only, render.
    """
    if words.batch is not None or words.more:
        return batch_of_evaluations(words)
    _ = path_of(words)  # refuses where none is named
    from aaplug.evaluation.results import results, tables
    from aaplug.verbs.evaluate import check_results

    # before the scene is read
    check_results(words.output, words.resume, words.overwrite, words.report, words.layout)
    inputs = read_inputs(words)
    report = aaplug.evaluate(*inputs, words.output, **told(words, verbs.EvaluateOptions))
    if words.json:
        print_json(results(report))
    else:
        show(*tables(report))
    return 0


@verb(
    *SCENE_AND_CAMERAS,
    output("FILE.webm", "The video: VP9 .webm, or H.264 .mp4."),
    verbs.VideoOptions,
    json_of("what was written as one JSON object"),
)
def video(words: Words) -> int:
    """Render a camera path to a video, classic 3DGS and aaplug side by side.

    For single images, use render; to move the camera by hand, view.
    """
    inputs = read_inputs(words)
    clip = aaplug.video(*inputs, words.output, **told(words, verbs.VideoOptions))
    if words.json:
        print_json(clip._asdict() | {"file": str(clip.file)})
    else:
        say(f"wrote {clip.file}")
    return 0


@dataclass(frozen=True, kw_only=True)
class GuardOptions(Options):
    """A guard for pipelines."""

    fail_under: Annotated[float | None, number(0, 200, unit="dB"), REPORT] = None
    """Exit with 1 if the mean PSNR of a scene at any scale is below so many dB: --fail-under 40dB."""


@verb(
    Option(
        "scenes",
        flag("SCENE SCENE [SCENE ...]", read=Path, by_place=True, count=None),
        "Two or more scenes of any format, or their folders; the first is what the others are held to.",
        (),
    ),
    Option("reference", flag("SCENE", read=Path), "The scene that the others are held to, instead of the first.", None),
    CameraOptions,
    output("FOLDER", "Folder for compare.json, compare.csv, report.html and contact-sheet.png.", None),
    verbs.CompareOptions,
    GuardOptions,
    FileOptions,
    Orbit,
    json_of("compare.json instead of the tables"),
)
def compare(words: Words) -> int:
    """Measure what compression, conversion, pruning or training again cost: scenes against the first, at every size.

    To measure recipes on one scene, use evaluate.
    """
    first, others = words.reference, [path for path in words.scenes if path != words.reference]
    paths = others if first is None else [first, *others]
    if words.reference is None:
        paths = list(words.scenes)
    if len(paths) < 2:
        raise UsageError("compare", f"needs two scenes or more, got {len(paths)}: aaplug compare A.ply B.spz")
    from aaplug.verbs.compare import check_compared

    check_compared(words.output, words.resume, words.overwrite)  # before anything is read
    scenes = [open_scene(words, path) for path in paths]
    cameras = read_cameras(words, scenes[0])
    comparison = aaplug.compare(scenes, cameras, words.output, **told(words, verbs.CompareOptions))
    if words.json:
        print_json(comparison.summary())
    else:
        show(*comparison.tables())
    least, lowest = words.fail_under, comparison.lowest
    if least is not None and lowest.value < least:
        say(f"{lowest.scene} at {lowest.scale:g}: mean PSNR {lowest.value:.2f} dB is below {least:g} dB")
        return FAILED
    return 0


@verb(
    *SCENE_AND_CAMERAS,
    FrameOptions,
    Option("limits", None, "Show every limit on files instead, and the environment variable that changes it.", False),
    json_of("one JSON object instead of a table"),
)
def info(words: Words) -> int:
    """Tell about a scene: its convention and why, what is fused, what is odd.

    With cameras it tells how finely they sample the scene.  To see the scene, use view; to measure images of it,
    evaluate.
    """
    if words.limits:
        return _show_limits(words.json)
    scene = open_scene(words)
    cameras = words.of(Orbit) if words.cameras is None else read_cameras(words, scene)
    facts = aaplug.info(scene, cameras, **told(words, FrameOptions))
    if words.json:
        print_json(facts)
        return 0
    facts = {key: value for key, value in facts.items() if key not in PROGRAM_KEYS and value != []}
    names = [key.removesuffix("_text").replace("_px2", " (px²)").replace("_", " ") for key in facts]
    show_rows(zip(names, map(_text, facts.values()), strict=True))
    return 0


def _text(value: Any) -> str:
    """A fact of `info` in words."""
    if value is None or isinstance(value, bool):
        return {None: "unknown", True: "yes", False: "no"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        lines = any(isinstance(item, str) for item in value)
        return ("\n" if lines else "  ").join(_text(item) for item in value)
    if isinstance(value, dict):
        return "  ".join(f"{name} px: {_text(share)}" for name, share in value.items())
    return f"{value:,}" if isinstance(value, int) else printable(str(value))


def _show_limits(as_json: bool) -> int:
    from aaplug.core.gaussians import MAX_LOG_SCALE
    from aaplug.io.limits import LIMITS, limit, usable_memory

    values = {name: limit(name) for name in LIMITS}
    fixed = {
        "LOG_SCALE": (MAX_LOG_SCALE, "", "a log-scale's absolute value, clamped on use"),
        "RENDER_SIDE": (MAX_SIDE, "px", "a side of a rendered image"),
    }
    if as_json:
        print_json(values | {name: value for name, (value, *_) in fixed.items()})
        return 0
    rows = [(n, f"{value:,}", LIMITS[n].unit, LIMITS[n].what, f"AAPLUG_{n}") for n, value in values.items()]
    rows += [(name, f"{value:,}", unit, what, "fixed") for name, (value, unit, what) in fixed.items()]
    show_rows(rows, ("limit", "value", "unit", "of", "set by"))
    if (memory := usable_memory()) is not None:
        show(f"Memory: {memory}.")
    return 0


@verb(
    output("FOLDER", "Folder for the converted scene, the contact sheet and the results.", Path("demo-out")),
    Option("overwrite", None, "Replace the files of an earlier demo.", False),
)
def demo(words: Words) -> int:
    """Convert, render and measure the bundled scene: a pretrained chair and four photographs.

    To try the installation.  For a scene of your own, use render, convert or evaluate.
    """
    from aaplug.evaluation.results import tables
    from aaplug.verbs.demo import SHEET

    show(*tables(aaplug.demo(words.output, overwrite=words.overwrite, monitor=TERMINAL)))
    say(f"look at {words.output / SHEET}")
    return 0


@verb(*SCENE_AND_CAMERAS, verbs.LiveOptions)
def view(words: Words) -> int:
    """Look at a scene live in the browser, classic 3DGS beside aaplug; without SCENE at the bundled sample.

    To write images, use render; for a moving camera, video.
    """
    scene = cameras = None
    if words.scene is not None or words.model_path is not None:
        scene, cameras = read_inputs(words)
    command = [word for options in (SceneOptions, CameraOptions, Orbit) for word in words.given(options)]
    command += [] if words.background == "auto" else ["--background", words.background]
    from aaplug.verbs.view import attend, serving

    with serving(scene, cameras, words=command, **told(words, verbs.LiveOptions)) as address:
        try:
            attend(address, TERMINAL, words.no_browser)
        except KeyboardInterrupt:  # the usual end
            say("closed")
    return 0


@verb(
    Option(
        "recipe",
        names(kind="recipe", metavar=RECIPE_METAVAR, count=None),
        "Compile what these recipes need, too; by default what auto, matched, classic and mip need.",
        (),
    ),
    json_of("where the kernels are as one JSON object"),
)
def warmup(words: Words) -> int:
    """Compile the fast rasterizer once for this machine (two to three minutes).

    The other verbs work without it, only slower.  To measure how fast it is, use bench.
    """
    kernels = aaplug.warmup(words.recipe, monitor=TERMINAL)
    say(f"{len(kernels.names)} kernels in {kernels.folder}")
    if words.json:
        print_json({"folder": str(kernels.folder), "kernels": kernels.names})
    return 0


@verb(
    Option("module", flag("MODULE", by_place=True), "The package, or one of its modules."),
    json_of("a list of objects, laws and problems"),
)
def check_plugin(words: Words) -> int:
    """Check what a package adds: filters, kernels, rasterizers, recipes, metrics and formats by their laws.

    While writing a plug-in.  To measure how good the recipes that it adds are, use evaluate.
    """
    verdicts = aaplug.check_plugin(words.module, monitor=TERMINAL)
    if words.json:
        print_json([verdict._asdict() for verdict in verdicts])
    else:
        for each in verdicts:
            outcome = f"FAILED: {each.problem}" if each.problem else "passed"
            print(printable(f"{each.kind} {each.name}: {each.law} {outcome}"))
    return FAILED if any(each.problem for each in verdicts) else 0


@verb(*SCENE_AND_CAMERAS, verbs.BenchOptions, json_of('one JSON object: the figures, or {"runs": [...]} of several'))
def bench(words: Words) -> int:
    """Time the rasterizer on synthetic scenes, or on SCENE with --cameras (its first training view).

    To measure how close images come to the truth, use evaluate; to compile the fast rasterizer, warmup.
    """
    scene = cameras = None
    if words.scene is not None or words.model_path is not None:
        scene, cameras = read_inputs(words)
    runs, exponents = aaplug.bench(scene, cameras, **told(words, verbs.BenchOptions))
    if words.json:
        several = {"runs": [run.as_json() for run in runs], "exponents": exponents}
        print_json(runs[0].as_json() if len(runs) == 1 else several)
        return 0
    import torch

    threads = words.threads or torch.get_num_threads()
    _show_times(f"medians, ms; matmul is a 2048³ float32 product, {threads} threads", runs, FIGURES)
    _show_times(
        "stages, ms", runs, {name: lambda run, name=name: f"{run.stages_ms[name]:.0f}" for name in runs[0].stages_ms}
    )
    for name, value in exponents.items():
        show(f"time grows as {name}^{value:.2f}")
    return 0


FIGURES: dict[str, Callable[["Figures"], str]] = {
    "forward": lambda run: f"{run.forward_ms:.0f}",
    "+ back": lambda run: "" if run.forward_backward_ms is None else f"{run.forward_backward_ms:.0f}",
    "matmul": lambda run: f"{run.matmul_ms:.0f}",
    "share": lambda run: f"{run.share:.2f}",
    "Mevals": lambda run: f"{run.evaluations / 1e6:.0f}",
    "ns/eval": lambda run: f"{run.ns_per_evaluation:.2f}",
    "GB": lambda run: f"{run.peak_bytes / 1e9:.1f}",
}


def _show_times(title: str, runs: Sequence["Figures"], columns: dict[str, Callable[["Figures"], str]]) -> None:
    """Print a row a run: the sizes of its scene and image, its rasterizer, and the columns."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("scene", "", *columns):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in runs:
        size = f"{run.gaussians:,} {run.width}x{run.height}"
        table.add_row(size, run.rasterizer, *(text(run) for text in columns.values()))
    show(table)
