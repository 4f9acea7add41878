"""aaplug render: images at new resolutions."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from aaplug.core.cameras import Camera
from aaplug.core.errors import OutputError, UsageError, listing
from aaplug.core.gaussians import Gaussians
from aaplug.core.training import TrainingViews
from aaplug.io.atomic import check_output
from aaplug.methods.recipes import RECIPES, Recipe, find_recipe, suited
from aaplug.rendering.frames import Frames, write_frames
from aaplug.rendering.renderer import rate_of, smooth

from .console import print_json, progress, say
from .files import make_folder, refuse_existing
from .options import CameraOptions, RenderOptions, SceneOptions, flag

MAX_SIDE = 16384  # px


@dataclass(frozen=True)
class Render:
    """Render views at any resolution to PNG."""

    output: Annotated[Path, flag("PATH", "-o")]
    """A folder for the images, or one .png for one view."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    rendering: RenderOptions = field(default_factory=RenderOptions)
    recipe: Annotated[str, tyro.conf.arg(metavar="|".join(RECIPES))] = "auto"
    """How to render."""
    scale: Annotated[float | None, flag("FACTOR")] = None
    """Size against the training size (default 1)."""
    resolution: Annotated[str | None, flag("WxH")] = None
    """Size in px, such as 400x400; -1 on one side keeps the aspect (-1x720)."""
    bit_depth: Literal[8, 16] = 8
    """Bits a colour channel."""
    overwrite: bool = False
    """Replace existing images."""
    json: bool = False
    """Print what was written as one JSON object on stdout."""


def render(options: Render) -> int:
    """Render views at any resolution to PNG."""
    size = size_of(options.scale, options.resolution)
    recipe = find_recipe(
        options.recipe, quality=options.rendering.quality, rate=options.rendering.rate
    )
    scene = options.scene.read()
    recipe = suited(recipe, scene)
    cameras = options.cameras.read(options.scene)
    views = [size(view) for view in options.rendering.select(cameras)]
    paths = _paths(options.output, views, options.overwrite)
    background = options.rendering.background_of(cameras)
    training = options.cameras.learn(scene, cameras)
    scene = smooth(scene, training, recipe)
    say(_choice(recipe, views, scene, training))
    rasterizer = options.rendering.rasterize(len(views))
    if not options.output.suffix:
        make_folder(options.output)
    depth, overwrite = options.bit_depth, options.overwrite
    frames = Frames(scene, training, recipe, background, views, paths, depth, overwrite)
    with progress("rendering", "views") as tell:
        write_frames(frames, rasterizer, torch.get_num_threads(), tell)
    if options.json:
        images = [
            {"view": v.name, "file": str(p), "width": v.width, "height": v.height}
            for v, p in zip(views, paths, strict=True)
        ]
        print_json({"recipe": recipe.name, "images": images})
    else:
        say(f"wrote {len(paths)} image{'s' * (len(paths) != 1)} to {options.output}")
    return 0


def size_of(scale: float | None, resolution: str | None) -> Callable[[Camera], Camera]:
    """The function that gives a view its new size."""
    if scale is not None and resolution is not None:
        raise UsageError("--scale and --resolution", "both say how large; give one")
    if resolution is not None:
        return lambda view: _checked(view.resized(*_resolution(resolution, view)))
    factor = 1.0 if scale is None else scale
    if not factor > 0:
        raise UsageError("--scale", f"must be above 0, got {factor:g}")
    return lambda view: _checked(view.scaled(factor))


def _resolution(text: str, view: Camera) -> tuple[int, int]:
    match = re.fullmatch(r"(-?\d+)x(-?\d+)", text)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if max(width, height) < 1 or min(width, height) == 0:
        raise UsageError(
            "--resolution", f"expected WIDTHxHEIGHT such as 400x400 or -1x720, got '{text}'"
        )
    if width < 0:
        width = max(1, round(view.width * height / view.height))
    if height < 0:
        height = max(1, round(view.height * width / view.width))
    return width, height


def _checked(view: Camera) -> Camera:
    if max(view.hw) > MAX_SIDE:
        raise UsageError(
            view.name, f"would be {view.width}x{view.height} px; the limit is {MAX_SIDE} a side"
        )
    return view


def _paths(output: Path, views: Sequence[Camera], overwrite: bool) -> list[Path]:
    """One file a view, none of which may exist already or twice; asked before anything is rendered."""
    if output.suffix:
        if output.suffix.lower() != ".png" or len(views) != 1:
            raise OutputError(
                output, f"name a folder, or one .png for one view ({len(views)} views asked for)"
            )
        check_output(output, overwrite)
        return [output]
    names = [re.sub(r"[^\w.\-]+", "_", view.name).lstrip(".") or "view" for view in views]
    if len({name.casefold() for name in names}) < len(names):
        names = [f"{index:05d}_{name}" for index, name in enumerate(names)]
    paths = [output / f"{name}.png" for name in names]
    refuse_existing(paths, overwrite)
    return paths


def _choice(recipe: Recipe, views: Sequence[Camera], scene: Gaussians, training: TrainingViews) -> str:
    """What is about to be rendered and why, in words."""
    rates = [rate_of(scene, view, training) for view in views]
    samples = sorted({recipe.samples_at(rate) for rate in rates})
    grid = " or ".join(f"{n}×{n}" for n in samples)
    sizes = listing(sorted({f"{view.width}x{view.height}" for view in views}), most=3)
    trained = training.convention
    span = " to ".join(dict.fromkeys(f"{rate:.3g}" for rate in (min(rates), max(rates))))
    kind = f"{trained.name} scene" + (" of 2D Gaussians" if scene.flat else "")
    return (
        f"recipe: {recipe.name} for a {kind}, {len(views)} view{'s' * (len(views) != 1)} at {sizes}, "
        f"{span} × the rate of training: {grid} sample{'s' * (samples != [1])} a pixel"
    )
