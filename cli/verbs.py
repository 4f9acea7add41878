"""The table of verbs: the options of each, and how it reads, calls the library and tells what came of it."""

import sys
from collections.abc import Callable
from dataclasses import MISSING, asdict
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aaplug
from aaplug.options import verbs
from aaplug.options.base import SWITCH, Option, Options, as_path, flag, names, number
from aaplug.options.verbs import MAX_SIDE, RECIPE_METAVAR, RECIPE_NAMES, REPORT, FrameOptions, Orbit
from aaplug.system.errors import UsageError, counted, printable

from .batch import BATCH, SEVERAL, batch_of_evaluations, for_each_scene, refuse_without_batch
from .console import TERMINAL, say, table
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
from .words import VERBS, Answer, Command, Words, json_of, output, scene_paths

if TYPE_CHECKING:
    from aaplug.rendering.benchmark import Figures

HERE = Path(__file__).resolve().parent
GUIDES = {each.stem: each for each in sorted(HERE.glob("guides/*.md")) or sorted(HERE.glob("../examples/guides/*.md"))}
PROGRAM_KEYS = ("fused", "comments")  # of `info`, for programs; the table has words for the first
NOTED = ("notes", "cameras")  # of `info`, which name parameters
WRITTEN = (
    "File to write: .ply; .compressed.ply, .sog, .spz, .glb, .gltf, .usda, .usdc, .usdz or .splat, which keep less "
    "(see `aaplug guide formats`)"
)

Run = Callable[[Words], Answer]


def verb(*options: type[Options] | Option) -> Callable[[Run], Run]:
    """Enter a function into the table with its options; its docstring is the verb's help."""

    def enter(run: Run) -> Run:
        name = run.__name__.replace("_", "-")
        VERBS[name] = Command(name, cleandoc(run.__doc__ or ""), options, run)
        return run

    return enter


@verb(
    *SCENE_AND_CAMERAS,
    output("PATH", "A folder for the images, or one file for one view: .png, .jpg, .webp, .exr, .npz."),
    verbs.RenderOptions,
    json_of("the files as one JSON object"),
)
def render(words: Words) -> Answer:
    """Render views of a scene at any size to image files.

    To measure how close images come to the truth, use evaluate; for a moving camera, video.
    """
    inputs = read_inputs(words)
    written = aaplug.render(*inputs, words.output, **told(words, verbs.RenderOptions))
    say(f"wrote {counted(len(written), 'image')} to {words.output}")
    images = [{"view": v.name, "file": str(p), "width": v.width, "height": v.height} for v, p in written]
    return Answer({"recipe": words.recipe, "images": images})


@verb(
    *SCENE_AND_CAMERAS,
    output("FILE", WRITTEN + "; with --batch or for a scene in time, a folder."),
    verbs.ConvertOptions,
    *SEVERAL,
    json_of("what was done as one JSON object"),
)
def convert(words: Words) -> Answer:
    """Fuse anti-aliasing into a plain scene file, for viewers with a fixed 2D filter.

    It takes seconds for the 2D Mip filter (0.1 px², compensated), and minutes for a viewer named by --for.  The number
    of Gaussians stays.  For fewer, use lod; to move the Gaussians until all sizes look right, finetune.
    """
    if words.batch is not None:
        return for_each_scene(words, lambda scene: ".ply", lambda scene: scene.output.is_file())
    refuse_without_batch(words, "resume", "scheduler")
    inputs = read_inputs(words)
    result = aaplug.convert(*inputs, words.output, **told(words, verbs.ConvertOptions))
    from aaplug.evaluation.results import tables
    from aaplug.io.scenes import kind_written, written_format
    from aaplug.methods.conversion import described_fusions

    format = written_format(words.output)  # None for a folder of frames, which are .ply
    how = "frame by frame" if format is None else "part by part"
    if result.scene is not None:
        how = f"fused {described_fusions(result.scene.fused)}"
    say(f"wrote {words.output}: {how}; show it with {result.viewer.rule} ({result.viewer.name})")
    if advice := result.viewer.advice(kind_written(words.output), words.output.name):
        say(advice)
    title = "As the viewer draws it, against the scene's own training-size render:"
    shown = [] if result.report is None else [title, tables(result.report)[0]]
    return Answer({"output": str(words.output)} | result.as_json(), shown)


@verb(
    *SCENE_AND_CAMERAS,
    output("PATH", "The one scene's file (as of convert), or a folder for levels or, with --batch, for all."),
    verbs.LodOptions,
    *SEVERAL,
    json_of("what was made as one JSON object"),
)
def lod(words: Words) -> Answer:
    """Merge Gaussians: into levels of detail, or into one lighter scene (--simplify, --budget).

    Levels make small images faster and cleaner.  To keep every Gaussian, use convert or finetune.
    """
    if words.batch is not None:
        from aaplug.verbs.lod import is_made

        return for_each_scene(
            words,
            lambda scene: ".ply" if scene.of(verbs.LodOptions).single else "",
            lambda scene: is_made(scene.output, scene.of(verbs.LodOptions)),
        )
    refuse_without_batch(words, "scheduler")
    scene, cameras = read_inputs(words)
    levels = aaplug.lod(scene, cameras, words.output, **told(words, verbs.LodOptions))
    *finer, last = (len(level.scene) for level in levels)
    say(f"wrote {words.output}: {' > '.join([*(f'{count:,}' for count in finer), counted(last, 'Gaussian')])}")
    counts = [{"rate": level.rate, "gaussians": len(level.scene)} for level in levels]
    return Answer({"output": str(words.output), "gaussians": scene.count, "levels": counts})


@verb(
    *SCENE_AND_CAMERAS,
    output("FILE", WRITTEN + "."),
    verbs.FinetuneOptions,
    json_of("the report as JSON instead of the table"),
)
def finetune(words: Words) -> Answer:
    """Optimize the Gaussians until every scale looks like the training size, averaged down; write a plain scene file.

    It takes minutes to hours and gives the closest images at one sample per pixel; convert takes seconds to minutes.
    A report (.finetune.json), pictures (.finetune.png) and a checkpoint go beside the file.  Ctrl-C stops after the
    current step; --resume continues.
    """
    inputs = read_inputs(words)
    tuned = aaplug.finetune(*inputs, words.output, **told(words, verbs.FinetuneOptions))
    from aaplug.evaluation.results import tables

    say(f"wrote {words.output}, {words.output.stem}.finetune.json and {words.output.stem}.finetune.png")
    return Answer(tuned.as_json(), tables(tuned.report))


@verb(
    SceneOptions,
    scene_paths(
        "more",
        "[SCENE ...]",
        "More scenes, with the same --cameras or each a model folder.  Each gets its own folder of results.",
    ),
    BATCH,
    flag("FOLDER", read=as_path).named(
        "models",
        "With a folder of the --protocol's scenes: the trained scenes, if they do not lie with the photographs.",
    ),
    SWITCH.named("skip", "With such a folder: leave out scenes that are missing or fail; the table says which."),
    CameraOptions,
    Orbit,
    output("FOLDER", "Folder for results.json, per_view.json and results.csv.", None),
    verbs.EvaluateOptions,
    json_of("results.json instead of the table"),
)
def evaluate(words: Words) -> Answer:
    """Measure recipes at several scales, against photographs or the scene's own look; one scene or many.

    A folder of all scenes of NeRF-synthetic (--protocol blender) or Mip-NeRF 360 (360-zoom-out, 360-zoom-in) gives the
    papers' table.  To measure scene files against each other, use compare; for images only, render.
    """
    if words.batch is not None or words.more:
        return batch_of_evaluations(words)
    path = path_of(words)  # refuses where none is named
    from aaplug.evaluation.data_sets import is_set

    if is_set(str(words.protocol), path) or words.models is not None or words.skip:
        return batch_of_evaluations(words, of_set=True)
    from aaplug.evaluation.results import results, tables
    from aaplug.verbs.evaluate import check_results

    # before the scene is read
    check_results(words.output, words.resume, words.overwrite, words.report, words.layout)
    inputs = read_inputs(words)
    report = aaplug.evaluate(*inputs, words.output, **told(words, verbs.EvaluateOptions))
    return Answer(results(report), tables(report))


@verb(
    *SCENE_AND_CAMERAS,
    output("PATH", "The video: VP9 .webm, or H.264 .mp4; or frames of one file each: frame.####.exr."),
    verbs.VideoOptions,
    json_of("what was written as one JSON object"),
)
def video(words: Words) -> Answer:
    """Render a camera path to a video, classic 3DGS and aaplug side by side, or to a frame sequence.

    For single images, use render; to move the camera by hand, view.
    """
    inputs = read_inputs(words)
    clip = aaplug.video(*inputs, words.output, **told(words, verbs.VideoOptions))
    say(f"wrote {clip.file}")
    return Answer(clip._asdict() | {"file": str(clip.file)})


@verb(
    scene_paths(
        "scenes",
        "SCENE SCENE [SCENE ...]",
        "Two or more scenes of any format, or their folders; the others are compared with the first.",
    ),
    flag("SCENE", read=as_path).named("reference", "The scene to compare the others with, instead of the first."),
    CameraOptions,
    output("FOLDER", "Folder for compare.json, compare.csv, report.html and contact-sheet.png.", None),
    verbs.CompareOptions,
    number(0, 200, unit="dB").named(
        "fail_under",
        "Exit with 1 if the mean PSNR of a scene but the first is below so many dB at any scale: --fail-under 40dB.",
        group=REPORT,
    ),
    FileOptions,
    Orbit,
    json_of("compare.json instead of the tables"),
)
def compare(words: Words) -> Answer:
    """Measure how far compressed, converted, pruned or retrained scenes are from the first, at every size.

    To measure recipes on one scene, use evaluate.
    """
    first = words.reference
    paths = [*words.scenes] if first is None else [first, *(path for path in words.scenes if path != first)]
    if len(paths) < 2:
        raise UsageError("compare", f"needs two scenes or more, got {len(paths)}: aaplug compare A.ply B.spz")
    if words.fail_under is not None and "psnr" not in map(str.lower, words.metric):
        raise UsageError("fail_under", "is of PSNR, which `metric` leaves out")
    from aaplug.verbs.compare import check_compared

    check_compared(words.output, words.resume, words.overwrite, words.show)  # before anything is read
    scenes = [open_scene(words, path) for path in paths]
    cameras = read_cameras(words, scenes[0])
    comparison = aaplug.compare(scenes, cameras, words.output, **told(words, verbs.CompareOptions))
    least, lowest = words.fail_under, comparison.lowest
    failed = least is not None and lowest.value < least
    if failed:
        say(f"{lowest.scene} at {lowest.scale:g}: mean PSNR {lowest.value:.2f} dB is below {least:g} dB")
    return Answer(comparison.summary(), comparison.tables(), failed)


@verb(
    scene_paths("scenes", "SCENE [SCENE ...]", "The scenes, of any format."),
    CameraOptions,
    output("FILE", WRITTEN + "."),
    verbs.MergeOptions,
    FileOptions,
    json_of("what was done as one JSON object"),
)
def merge(words: Words) -> Answer:
    """Put scenes into one file, each moved, turned and scaled, in one convention.

    Scenes of several conventions are converted; --cameras, or those of each model folder, tell training's sampling
    rates.  To make one scene lighter, use lod.
    """
    scenes = [open_scene(words, path) for path in words.scenes]
    cameras = read_cameras(words, scenes[0]) if words.cameras else None
    merged = aaplug.merge(scenes, cameras, words.output, **told(words, verbs.MergeOptions))
    say(f"wrote {words.output}: {counted(len(merged), 'Gaussian')}, {merged.convention.name}")
    return Answer({"output": str(words.output), "gaussians": len(merged), "convention": merged.convention.name})


@verb(
    *SCENE_AND_CAMERAS,
    FrameOptions,
    SWITCH.named("limits", "Show every limit on files instead, and the environment variable that changes it."),
    json_of("one JSON object instead of a table"),
)
def info(words: Words) -> Answer:
    """Describe a scene: its convention and the evidence for it, fused filters, and odd values.

    With cameras, also their sampling rates.  To see the scene, use view; to measure images of it,
    evaluate.
    """
    if words.limits:
        return _limits()
    inputs = read_inputs(words)
    facts = aaplug.info(*inputs, **told(words, FrameOptions))
    shown = {key: value for key, value in facts.items() if key not in PROGRAM_KEYS and value != []}
    names = [key.removesuffix("_text").replace("_px2", " (px²)").replace("_", " ") for key in shown]
    texts = [words.command.worded(_text(value)) if key in NOTED else _text(value) for key, value in shown.items()]
    return Answer(facts, [table(zip(names, texts, strict=True))])


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
        between = "\n" if any(isinstance(item, dict) for item in value.values()) else "  "
        return between.join(f"{name}{' px' * name.isdigit()}: {_text(item)}" for name, item in value.items())
    return f"{value:,}" if isinstance(value, int) else printable(str(value))


def _limits() -> Answer:
    from aaplug.core.gaussians import MAX_LOG_SCALE
    from aaplug.io.limits import LIMITS, limit, usable_memory

    values = {name: limit(name) for name in LIMITS}
    fixed = {
        "LOG_SCALE": (MAX_LOG_SCALE, "", "a log-scale's absolute value, clamped on use"),
        "RENDER_SIDE": (MAX_SIDE, "px", "a side of a rendered image"),
    }
    rows = [(n, f"{value:,.12g}", LIMITS[n].unit, LIMITS[n].what, f"AAPLUG_{n}") for n, value in values.items()]
    rows += [(name, f"{value:,.12g}", unit, what, "fixed") for name, (value, unit, what) in fixed.items()]
    shown = [table(rows, ("limit", "value", "unit", "of", "set by"))]
    if (memory := usable_memory()) is not None:
        shown.append(f"Memory: {memory[1]}.")
    return Answer(values | {name: value for name, (value, *_) in fixed.items()}, shown)


@verb(
    output("FOLDER", "Folder for the converted scene, the contact sheet and the results.", Path("demo-out")),
    SWITCH.named("overwrite", "Replace the files of an earlier demo."),
)
def demo(words: Words) -> Answer:
    """Convert, render and measure the bundled scene: a pretrained chair and four photographs.

    To try the installation.  For a scene of your own, use render, convert or evaluate.
    """
    from aaplug.evaluation.results import tables
    from aaplug.verbs.demo import SHEET

    report = aaplug.demo(words.output, overwrite=words.overwrite, monitor=TERMINAL)
    say(f"look at {words.output / SHEET}")
    return Answer(None, tables(report))


@verb(*SCENE_AND_CAMERAS, verbs.LiveOptions)
def view(words: Words) -> Answer:
    """Show a scene live in the browser, classic 3DGS beside aaplug; without SCENE, the bundled sample.

    To write images, use render; for a moving camera, video.
    """
    scene, cameras = read_inputs(words) if words.scene or words.model_path else (None, None)
    command = [word for options in SCENE_AND_CAMERAS for word in words.given(options)]
    command += [] if words.background == "auto" else ["--background", words.background]
    aaplug.view(scene, cameras, words=command, **told(words, verbs.LiveOptions))
    return Answer(None)


@verb(
    names(kind="recipe", metavar=RECIPE_METAVAR, count=None).named(
        "recipe", "Recipes whose kernels to compile, beside those of auto, matched, classic and mip.", default=()
    ),
    flag("FOLDER", read=as_path).named(
        "bundle",
        "Compile into a folder, for other machines with the same torch: for x86-64-v3 and x86-64-v4."
        " Where AAPLUG_KERNELS names the folder, no compiler is needed.",
    ),
    json_of("where the kernels are as one JSON object"),
)
def warmup(words: Words) -> Answer:
    """Compile the fast rasterizer once for this machine (about three minutes on two free cores).

    The other verbs work without it, only slower.  To measure how fast it is, use bench.
    """
    kernels = aaplug.warmup(words.recipe, words.bundle, monitor=TERMINAL)
    say(f"{counted(len(kernels.names), 'kernel')} in {kernels.folder}")
    return Answer({"folder": str(kernels.folder), "kernels": kernels.names})


@verb(
    flag("MODULE", by_place=True).named("module", "The package, or one of its modules.", default=MISSING),
    json_of("a list of objects, laws and problems"),
)
def check_plugin(words: Words) -> Answer:
    """Test the filters, kernels, rasterizers, recipes, metrics, losses and formats of a package by their laws.

    For authors of plug-ins.  To measure the recipes that it adds, use evaluate.
    """
    verdicts = aaplug.check_plugin(words.module, monitor=TERMINAL)
    outcomes = [f"FAILED: {each.problem}" if each.problem else "passed" for each in verdicts]
    lines = [f"{v.kind} {v.name}: {v.law} {outcome}" for v, outcome in zip(verdicts, outcomes, strict=True)]
    return Answer([verdict._asdict() for verdict in verdicts], lines, any(each.problem for each in verdicts))


@verb(
    flag("[PROGRAM]", by_place=True).named(
        "program",
        "A command line in quotes, in which {scene}, {camera} and {image} stand for the .ply, the camera's .json and"
        " the .png to write; without them, the three are added at the end.",
    ),
    flag("FOLDER", read=as_path).named("images", "Instead: pictures made by hand, such as dilation.png."),
    output("FOLDER", "Folder for scenes, cameras and pictures; alone, it gets the expected pictures.", None),
    verbs.ConformOptions,
    json_of("the verdicts as one JSON object"),
)
def conform(words: Words) -> Answer:
    """Test a renderer by its pictures of ten tiny scenes, and name what it draws wrong.

    Exits with 1 if anything is wrong.  To fit a scene to a viewer's rule instead, use convert --for.
    """
    verdict = aaplug.conform(words.program, words.images, words.output, **told(words, verbs.ConformOptions))
    if verdict is None:
        return Answer(None)
    how = "" if verdict.stated else ", which fits best"
    say(f"expected: {verdict.viewer.name} ({verdict.viewer.program}: {verdict.viewer.rule}){how}")
    headings = ("test", "verdict", "error", "what is wrong")
    rows = [
        (f.test, "wrong" if f.wrong else "right", "" if f.error is None else f"{f.error:.1f}", f.wrong)
        for f in verdict.findings
    ]
    facts = {"viewer": verdict.viewer.name, "stated": verdict.stated, "right": verdict.right}
    tests = [finding._asdict() for finding in verdict.findings]
    return Answer(facts | {"tests": tests}, [table(rows, headings)], not verdict.right)


@verb(*SCENE_AND_CAMERAS, verbs.BenchOptions, json_of('the figures, or {"runs": [...]} of several, as one JSON object'))
def bench(words: Words) -> Answer:
    """Time the rasterizer on synthetic scenes, or on the first training view of SCENE.

    To measure how close images come to the truth, use evaluate; to compile the fast rasterizer, warmup.
    """
    scene, cameras = read_inputs(words) if words.scene or words.model_path else (None, None)
    if scene is None and words.cameras:
        raise UsageError("--cameras", "belongs to a scene; name one, too")
    runs, exponents = aaplug.bench(scene, cameras, **told(words, verbs.BenchOptions))
    from aaplug.system.executors import given_threads

    threads = words.threads or given_threads()
    headings = ("Gaussians", "px, by")
    sizes = [(f"{run.gaussians:,}", f"{run.width}x{run.height} {run.rasterizer}") for run in runs]
    figures = [(*size, *(text(run) for text in FIGURES.values())) for size, run in zip(sizes, runs, strict=True)]
    stages = [(*size, *(f"{ms:.0f}" for ms in run.stages_ms.values())) for size, run in zip(sizes, runs, strict=True)]
    unit = "exp/eval: a frame's time for each evaluation, in exponentials of torch"
    shown = [f"medians in ms, {counted(threads, 'thread')}; {unit}"]
    shown += [table(figures, (*headings, *FIGURES)), "stages in ms", table(stages, (*headings, *runs[0].stages_ms))]
    shown += [f"time grows as {name}^{value:.2f}" for name, value in exponents.items()]
    several = {"runs": [run.as_json() for run in runs], "exponents": exponents}
    return Answer(runs[0].as_json() if len(runs) == 1 else several, shown)


FIGURES: dict[str, Callable[["Figures"], str]] = {
    "forward": lambda run: f"{run.forward_ms:.0f}",
    "+ back": lambda run: f"{run.forward_backward_ms:.0f}",
    "exp/eval": lambda run: f"{run.exponentials:.2f}",
    "calls": lambda run: f"{sum(run.calls.values()):,}",
    "ns/eval": lambda run: f"{run.ns_per_evaluation:.2f}",
    "GB": lambda run: "" if run.peak_bytes is None else f"{run.peak_bytes / 1e9:.1f}",
}


@verb(json_of("the table as a list of objects"))
def viewers(words: Words) -> Answer:
    """List the viewers that --for knows: the 2D filter of each, where its splats end, and the settings to choose.

    To fit a scene to one of them, use convert; to draw scenes as it does, compare.
    """
    from aaplug.methods.viewers import VIEWERS

    headings = ("--for", "adds; where a splat ends", "program, what to choose there, and how the rule is known")
    all_of = VIEWERS.values()
    rows = [(v.name, f"{v.rule}; {v.end}", f"{v.program} ({v.evidence}): {v.choice}") for v in all_of]
    return Answer([asdict(viewer) for viewer in all_of], [table(rows, headings)])


@verb(json_of("the table as a list of objects"))
def recipes(words: Words) -> Answer:
    """List the recipes that --recipe knows: the method and source of each, its cost, and when to use it.

    Samples are per pixel, at 1/2, 1/4 and 1/8 of the training size if they differ.  Where no time is given, it
    is about that of classic, or not known.  To measure recipes on a scene, use evaluate.
    """
    from aaplug.methods import RECIPES

    facts = [
        {"name": r.name, "source": r.source, "cost": r.cost, "when": r.when, "comparison": r.name not in RECIPE_NAMES}
        for r in RECIPES.values()
    ]
    headings = ("--recipe", "cost", "when to use it", "what it is, and whose")
    rows = [[(f["name"], f["cost"], f["when"], f["source"]) for f in facts if f["comparison"] == of] for of in (0, 1)]
    return Answer(facts, [table(rows[0], headings), "For comparison:", table(rows[1], headings)])


@verb(names(*GUIDES, metavar="[NAME]", by_place=True).named("name", "The guide to print."))
def guide(words: Words) -> Answer:
    """List the guides, or print one.

    For a verb's own options, use --help; to see aaplug at work, demo.
    """
    texts = {name: file.read_text("utf-8") for name, file in GUIDES.items() if words.name in (None, name)}
    if words.name is None:
        return Answer(None, [table((name, text.partition("\n")[0].removeprefix("# ")) for name, text in texts.items())])
    if not sys.stdout.isatty():
        return Answer(None, texts[words.name].splitlines())
    from rich.markdown import Markdown, TableDataElement

    class Cell(TableDataElement):
        def __init__(self, justify: Any) -> None:
            super().__init__(justify)
            self.content.overflow = "fold"  # a long word keeps its end

    Markdown.elements.update(th_open=Cell, td_open=Cell)
    return Answer(None, [Markdown(texts[words.name])])
