"""aaplug evaluate: every recipe at every scale, measured."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from aaplug.core.errors import UsageError
from aaplug.evaluation.metrics import METRICS, metric_option
from aaplug.evaluation.protocols import PROTOCOLS
from aaplug.evaluation.results import Report, results, tables
from aaplug.verbs.batch import batch
from aaplug.verbs.evaluate import ALL, DEFAULT_RECIPES, Output
from aaplug.verbs.evaluate import evaluate as measure

from .batch import scenes_of
from .console import TERMINAL, out, print_json
from .options import RECIPE_NAMES, CameraOptions, RenderOptions, SceneOptions, arguments, choice, flag

FAILED = 1  # exit code


@dataclass(frozen=True)
class OtherScenes:
    """More scenes."""

    more: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("[SCENE ...]")] = ()
    """More scenes, with the same --cameras or each a model folder.  Each gets its own folder of results."""


@dataclass(frozen=True)
class Evaluate:
    """Measure recipes over scales, against photographs or against the scene's own look; of one scene or many."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    others: OtherScenes = field(default_factory=OtherScenes)
    batch: Annotated[Path | None, flag("FILE.toml")] = None
    """Scenes and their settings from a file; what it does not say is as on the command line."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for results.json, per_view.json and results.csv."""
    protocol: Annotated[str, choice(PROTOCOLS)] = "default"
    """Scales, truth, downscaling and flavours of metrics, by name."""
    recipe: Annotated[tuple[str, ...], choice([*RECIPE_NAMES, ALL, "..."])] = DEFAULT_RECIPES
    """One or more recipes.  all adds the research recipes, which examples/guides/methods.md lists."""
    scale: Annotated[tuple[float, ...] | None, flag("FACTOR [FACTOR ...]")] = None
    """One or more sizes relative to the training size (default: the protocol's)."""
    truth: Literal["auto", "photographs", "self"] = "auto"
    """Compare with photographs, or with the scene's own supersampled look; auto leaves it to the protocol."""
    metric: Annotated[tuple[str, ...] | None, flag("|".join(map(metric_option, METRICS)))] = None
    """Metrics, with flavours ssim:wang|3dgs, lpips:3dgs|vgg|alex (default: psnr ssim consistency energy-drift)."""
    lpips: Annotated[tuple[Path, Path] | None, flag("TRUNK HEADS")] = None
    """Weights of LPIPS, which is then measured: torchvision's VGG16 (AlexNet), and the lpips package's heads for it."""
    report: bool = False
    """Write report.html, one page with tables, curves and a before/after viewer, and its plots."""
    show: Annotated[str, tyro.conf.arg(metavar="N|NAME,...")] = "3"
    """Views in the report's viewer: how many, or which."""
    layout: Literal["plain", "inria"] = "plain"
    """inria stores every render and its truth in test/METHOD/{renders,gt}, where other metric scripts look."""
    resume: bool = False
    """Continue an interrupted evaluation; finished views are not measured again."""
    overwrite: bool = False
    """Replace existing results."""
    json: bool = False
    """Print results.json on stdout instead of the table."""


def evaluate(options: Evaluate) -> int:
    """Measure recipes over scales, of one scene or of many."""
    if options.batch is not None or options.others.more:
        return _evaluate_many(options)
    wanted = options.output, options.report, options.layout, options.resume, options.overwrite
    Output(*wanted).check()  # before the scene is read
    report = _run(options)
    _print(options, results(report), tables(report))
    return 0


def _run(options: Evaluate, **given: Any) -> Report:
    """Evaluate one scene; `given` has precedence over the options."""
    scene = options.scene.read()
    cameras = options.cameras.read(options.scene)
    own = {"name": options.scene.path.stem, "monitor": TERMINAL}
    return measure(scene, cameras, **arguments(options, measure) | own | given)


def _evaluate_many(options: Evaluate) -> int:
    scenes = _scenes(options)
    output = scenes[0][1].output
    if output is None:
        raise UsageError("output", "name a folder for the results of several scenes: -o FOLDER")
    runs = [(name, partial(_run, own)) for name, own in scenes]
    found = batch(runs, output, resume=options.resume, overwrite=options.overwrite, monitor=TERMINAL)
    _print(options, found.summary(), found.tables())
    return FAILED if found.failures else 0


def _scenes(options: Evaluate) -> list[tuple[str, Evaluate]]:
    """The scenes that a batch file or the command line names, with their options.

    Raises:
        UsageError: both name scenes, or there are no cameras.
        FormatError: the batch file names no scenes, or a setting does not fit.
    """
    if options.batch is not None:
        if named := options.others.more or options.scene.scene or options.scene.model_path:
            raise UsageError("batch", f"names the scenes; leave {named} out")
        return scenes_of(options.batch, replace(options, batch=None))
    paths = [options.scene.path, *options.others.more]
    if options.cameras.cameras is None and any(path.is_file() for path in paths):
        raise UsageError("cameras", "give them, or name model folders, which hold their own")
    return [(path.stem if path.is_file() else path.name, _of(path, options)) for path in paths]


def _of(path: Path, options: Evaluate) -> Evaluate:
    scene = replace(options.scene, scene=path, model_path=None)
    return replace(options, scene=scene, others=OtherScenes())


def _print(options: Evaluate, data: Any, grids: Any) -> None:
    if options.json:
        print_json(data)
    else:
        out.print(*grids)
