"""aaplug demo: the whole job on the bundled sample."""

from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import tyro
from aaplug_cli.console import out, progress, say
from aaplug_cli.evaluate import write_results
from aaplug_cli.files import make_folder, refuse_existing
from jaxtyping import Float
from torch import Tensor

from aaplug.cameras import WHITE, Camera
from aaplug.contact_sheet import contact_sheet
from aaplug.conversion import FORMS, default_form
from aaplug.conversion import convert as fuse
from aaplug.evaluation import Task
from aaplug.evaluation import evaluate as measure
from aaplug.gaussians import Gaussians
from aaplug.interfaces import Training
from aaplug.io.cameras import read_cameras
from aaplug.io.images import quantise, read_image, resampled, write_png
from aaplug.io.scenes import read_scene, write_scene
from aaplug.pipeline import learn, render
from aaplug.recipes import find_recipe
from aaplug.report import scale_name, table

SCALES = (1.0, 0.5, 0.25, 0.125)
RECIPES = ("classic", "mip", "matched", "auto")
SHOWN = "r_8"  # the view on the contact sheet
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
    names = ("chair-converted.ply", "contact-sheet.png", "results.json", "per_view.json")
    refuse_existing([options.output / name for name in names], options.overwrite)
    make_folder(options.output)
    with as_file(files("aaplug.sample")) as sample:
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
    write_results(report, options.output, options.overwrite)
    out.print(table(report))
    say(f"look at {options.output / names[1]}")
    return 0


def _sheet(
    scene: Gaussians, converted: Gaussians, training: Training, view: Camera
) -> Float[Tensor, "H W 3"]:
    assert view.photo is not None
    photo = quantise(read_image(view.photo, WHITE))
    rows = []
    for scale in SCALES:
        camera = view.scaled(scale)
        shown = [
            render(drawn, camera, find_recipe(name), training, background=WHITE).rgb
            for drawn, name in ((scene, "classic"), (scene, "auto"), (converted, "mip"))
        ]
        label = f"{scale_name(scale)}: {camera.width}x{camera.height}"
        rows.append((label, [resampled(photo, scale), *shown]))
    return contact_sheet(COLUMNS, rows)
