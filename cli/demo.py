"""aaplug demo: the whole job on the bundled sample."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import tyro
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import WHITE, Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Task
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.report.contact_sheet import contact_sheet
from aaplug.evaluation.results import scale_name, tables
from aaplug.io.cameras import read_cameras
from aaplug.io.images import quantised, read_image, resampled, write_png
from aaplug.io.scenes import read_scene, write_scene
from aaplug.methods.recipes import find_recipe
from aaplug.methods.viewers import FORMS, default_form
from aaplug.methods.viewers import convert as fuse
from aaplug.rendering.renderer import learn, render

from .console import out, progress, say
from .evaluate import write_results
from aaplug.io.folders import make_folder, refuse_existing

SCALES = (1.0, 0.5, 0.25, 0.125)
RECIPES = ("classic", "mip", "matched", "auto")
SHOWN = "r_136"  # the view on the contact sheet
COLUMNS = ("photograph", "classic 3DGS", "aaplug", "converted .ply, Mip viewer")


@dataclass(frozen=True)
class Demo:
    """Convert, render and measure the bundled sample scene: a pretrained chair and four photographs."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("demo-out")
    """Folder for the converted scene, the contact sheet and the results."""
    overwrite: bool = False
    """Replace the files of an earlier demo."""


def demo(options: Demo) -> int:
    """Convert, render and measure the bundled sample scene."""
    names = (
        "chair-converted.ply",
        "contact-sheet.png",
        "results.json",
        "per_view.json",
        "results.csv",
    )
    refuse_existing([options.output / name for name in names], options.overwrite)
    make_folder(options.output)
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply"), read_cameras(sample)
        say(
            f"sample: {len(scene):,} Gaussians, {len(cameras.train)} training cameras, 4 photographs"
        )
        training = learn(scene, cameras.train)
        converted = fuse(scene, training, FORMS[default_form(scene)])
        write_scene(options.output / names[0], converted, overwrite=options.overwrite)
        say(f"wrote {options.output / names[0]}")
        view = next(camera for camera in cameras.test if camera.name == SHOWN)
        sheet = _sheet(scene, converted, training, view)
        write_png(options.output / names[1], sheet, overwrite=options.overwrite)
        say(f"wrote {options.output / names[1]}")
        recipes = [find_recipe(name) for name in RECIPES]
        task = Task(recipes, SCALES, cameras.test, WHITE, "photographs")
        with progress("measuring", "views") as tell:
            report = measure(scene, training, task, progress=tell)
    write_results(report, options.output, options.overwrite, "chair")
    out.print(*tables(report))
    say(f"look at {options.output / names[1]}")
    return 0


def _sheet(
    scene: Gaussians, converted: Gaussians, training: TrainingViews, view: Camera
) -> Float[Tensor, "H W 3"]:
    assert view.photo is not None
    photo = quantised(read_image(view.photo, WHITE))
    classic = find_recipe("classic")
    rows, left, top, right, bottom = [], *_box(render(scene, view, classic, training).alpha)
    for scale in SCALES:
        camera = view.scaled(scale)
        images = [resampled(photo, scale)] + [
            render(drawn, camera, find_recipe(name), training, background=WHITE).rgb
            for drawn, name in ((scene, "classic"), (scene, "auto"), (converted, "mip"))
        ]
        y = slice(round(top * scale), round(bottom * scale))
        x = slice(round(left * scale), round(right * scale))
        label = f"{scale_name(scale)}: {camera.width}x{camera.height}"
        rows.append((label, [image[y, x] for image in images]))
    return contact_sheet(COLUMNS, rows)


def _box(alpha: Float[Tensor, "h w"]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what is drawn, on whole pixels of the smallest scale."""
    rows, columns = (alpha > 0.5).any(dim=1).nonzero(), (alpha > 0.5).any(dim=0).nonzero()
    step = round(1 / min(SCALES))
    low = [int(side.min()) // step * step for side in (columns, rows)]
    high = [-(-(int(side.max()) + 1) // step) * step for side in (columns, rows)]
    return low[0], low[1], high[0], high[1]
