"""aaplug evaluate: every recipe at every scale, measured."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from aaplug.core.errors import UsageError
from aaplug.evaluation.results import Report, results, tables
from aaplug.verbs.batch import batch
from aaplug.verbs.evaluate import EvaluateOptions, Output
from aaplug.verbs.evaluate import evaluate as measure

from .batch import scenes_of
from .console import TERMINAL, out, print_json
from .options import CameraOptions, Flat, SceneOptions, flag

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
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for results.json, per_view.json and results.csv."""
    how: Annotated[EvaluateOptions, Flat] = field(default_factory=EvaluateOptions)
    json: bool = False
    """Print results.json on stdout instead of the table."""


def evaluate(options: Evaluate) -> int:
    """Measure recipes over scales, of one scene or of many."""
    if options.batch is not None or options.others.more:
        return _evaluate_many(options)
    Output(options.output, options.how).check()  # before the scene is read
    report = _run(options)
    _print(options, results(report), tables(report))
    return 0


def _run(options: Evaluate, **given: Any) -> Report:
    """Evaluate one scene; `given` has precedence over the options."""
    scene = options.scene.read()
    cameras = options.cameras.read(options.scene)
    own = {"output": options.output, "name": options.scene.path.stem, "monitor": TERMINAL}
    return measure(scene, cameras, **vars(options.how) | own | given)


def _evaluate_many(options: Evaluate) -> int:
    scenes = _scenes(options)
    output = scenes[0][1].output
    if output is None:
        raise UsageError("output", "name a folder for the results of several scenes: -o FOLDER")
    runs = [(name, partial(_run, own)) for name, own in scenes]
    found = batch(runs, output, resume=options.how.resume, overwrite=options.how.overwrite, monitor=TERMINAL)
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
