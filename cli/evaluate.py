"""aaplug evaluate: every recipe at every scale, measured."""

import hashlib
import json
import math
import platform
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from aaplug.cameras import Camera
from aaplug.evaluation import Task
from aaplug.evaluation import evaluate as measure
from aaplug.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.recipes import RECIPES, find_recipe
from aaplug.report import Report, per_view, results, tables

from .console import out, print_json, progress, say
from .files import make_folder, refuse_existing
from .options import CameraOptions, RenderOptions, SceneOptions, flag

HASH_BLOCK = 1 << 20  # bytes read at once


@dataclass(frozen=True)
class Evaluate:
    """Measure recipes over scales, against photographs or against the scene's own look."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for results.json and per_view.json."""
    recipe: Annotated[tuple[str, ...], tyro.conf.arg(metavar="|".join(RECIPES))] = (
        "classic",
        "mip",
        "matched",
        "auto",
    )
    """One or more recipes."""
    scale: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)
    """One or more sizes against the training size, on either side of 1."""
    truth: Literal["auto", "photographs", "self"] = "auto"
    """Compare with photographs, or with the scene's own supersampled look; auto takes photographs where all exist."""
    overwrite: bool = False
    """Replace existing results."""
    json: bool = False
    """Print results.json on stdout instead of the table."""


def evaluate(options: Evaluate) -> int:
    """Measure recipes over scales."""
    if options.output is not None:
        written = [options.output / name for name in ("results.json", "per_view.json")]
        refuse_existing(written, options.overwrite)
    recipes = [
        find_recipe(name, quality=options.rendering.quality, rate=_rate(name, options))
        for name in options.recipe
    ]
    scene = options.scene.read()
    cameras = options.cameras.read(options.scene)
    views = options.rendering.select(cameras)
    truth = _truth(options.truth, views)
    background = options.rendering.background_of(cameras)
    training = options.cameras.learn(scene, cameras)
    rasterizer = options.rendering.rasterize(len(views) * len(recipes) * len(options.scale))
    task = Task(recipes, options.scale, views, background, truth, rasterizer)
    facts = _facts(scene, cameras.notes, views, truth)
    facts["guard"] = training.guard if math.isfinite(training.guard) else None
    with progress("evaluating", "views") as tell:
        report = measure(scene, training, task, facts, tell)
    if options.output is not None:
        write_results(report, options.output, options.overwrite)
    if options.json:
        print_json(results(report))
    else:
        out.print(*tables(report))
    return 0


def _rate(name: str, options: Evaluate):
    """--rate concerns the recipes that match one."""
    return options.rendering.rate if name in ("matched", "auto") else None


def write_results(report: Report, folder: Path, overwrite: bool) -> None:
    """Write results.json and per_view.json into a folder."""
    make_folder(folder)
    for name, data in (("results.json", results(report)), ("per_view.json", per_view(report))):
        with replacing(folder / name, overwrite) as stream:
            stream.write(json.dumps(data, indent=1, allow_nan=False).encode() + b"\n")
        say(f"wrote {folder / name}")


def _truth(choice: str, views: Any) -> Literal["photographs", "self"]:
    if choice != "auto":
        return "photographs" if choice == "photographs" else "self"
    truth = "photographs" if all(view.photo for view in views) else "self"
    say(
        f"truth: {truth}" + ("" if truth == "photographs" else " (not every view has a photograph)")
    )
    return truth


def _facts(scene: Gaussians, notes: Any, views: Any, truth: str) -> dict[str, Any]:
    """What the numbers depend on: versions, what was read and its hashes."""
    assert scene.origin is not None
    packages = ("aaplug", "torch", "numpy", "scikit-image", "opencv-contrib-python-headless")
    photos = [view.photo for view in views if view.photo] if truth == "photographs" else []
    return {
        "versions": {name: version(name) for name in packages}
        | {"python": platform.python_version()},
        "scene": {
            "file": Path(scene.origin.path).name,
            "sha256": _sha256([Path(scene.origin.path)]),
            "gaussians": len(scene),
            "convention": scene.convention.name,
            "evidence": scene.origin.evidence,
        },
        "cameras": {"notes": list(notes), "sha256": _cameras_sha256(views)},
        "photographs": {"count": len(photos), "sha256": _sha256(photos) if photos else None},
    }


def _sha256(paths: list[Path]) -> str:
    """Hash of the files' contents, one after another."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            while block := stream.read(HASH_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _cameras_sha256(views: list[Camera]) -> str:
    """Hash of the views as they were understood: names, sizes, intrinsics, poses."""
    understood = [
        [v.name, v.width, v.height, v.fx, v.fy, v.cx, v.cy, v.cam_from_world.tolist()]
        for v in views
    ]
    return hashlib.sha256(json.dumps(understood).encode()).hexdigest()
