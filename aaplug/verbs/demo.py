"""The whole job on the bundled sample: a pretrained chair and four photographs."""

from importlib.resources import as_file, files
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.colours import WHITE
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised, resampled
from aaplug.core.training import TrainingViews
from aaplug.evaluation.report.contact_sheet import contact_sheet
from aaplug.evaluation.report.files import RESULTS
from aaplug.evaluation.results import Report
from aaplug.io.atomic import AnyPath, output_folder, refuse_existing
from aaplug.io.cameras import read_cameras
from aaplug.io.images import read_image, write_png
from aaplug.io.scenes import read_scene
from aaplug.rendering.renderer import Renderer
from aaplug.system.contracts import contract
from aaplug.system.monitor import SILENT, Monitor
from aaplug.verbs.convert import convert
from aaplug.verbs.evaluate import evaluate

SCALES = (1.0, 0.5, 0.25, 0.125)
SHEET_VIEW = "r_136"
COLUMNS = ("photograph", "classic 3DGS", "aaplug", "converted .ply, Mip viewer")
CONVERTED, SHEET = "chair-converted.ply", "contact-sheet.png"


@contract
def demo(output: AnyPath = "demo-out", *, overwrite: bool = False, monitor: Monitor = SILENT) -> Report:
    """Convert, render and measure the bundled scene; write the converted scene, a contact sheet and the results.

    Raises:
        OutputError: in the folder `output` a file exists and `overwrite` is false, or cannot be written.
    """
    folder = Path(output)
    refuse_existing([folder / name for name in (CONVERTED, SHEET, *RESULTS)], overwrite)
    with output_folder(folder), as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply").gaussians(), read_cameras(sample)
        counts = f"{len(scene):,} Gaussians, {len(cameras.train)} training cameras"
        monitor.say(f"sample: {counts}, {len(cameras.test)} photographs")
        convert(scene, cameras, folder / CONVERTED, overwrite=overwrite, monitor=monitor)
        [view] = [camera for camera in cameras.test if camera.name == SHEET_VIEW]
        sheet = _sheet(scene, read_scene(folder / CONVERTED).gaussians(), TrainingViews.of(scene, cameras), view)
        write_png(folder / SHEET, sheet, overwrite=overwrite)
        monitor.say(f"wrote {folder / SHEET}")
        how = {"scale": SCALES, "metric": ("psnr", "ssim"), "name": "chair"}
        return evaluate(scene, cameras, folder, overwrite=overwrite, monitor=monitor, **how)


@torch.no_grad()
def _sheet(scene: Gaussians, converted: Gaussians, training: TrainingViews, view: Camera) -> Float[Tensor, "H W 3"]:
    """The view at every scale: the photograph, and each way to render it."""
    assert view.photo is not None
    photo = quantised(read_image(view.photo, WHITE))
    renderers = [
        Renderer.of(shown, training, recipe, background=WHITE)
        for shown, recipe in ((scene, "classic"), (scene, "auto"), (converted, "mip"))
    ]
    # where the chair is, in pixels of the smallest scale, which are whole at the others
    places = (renderers[0](view.scaled(min(SCALES))).alpha > 0.5).nonzero()
    (top, left), (bottom, right) = places.amin(dim=0).tolist(), (places.amax(dim=0) + 1).tolist()
    rows = list[tuple[float, list[Tensor]]]()
    for scale in SCALES:
        camera, times = view.scaled(scale), round(scale / min(SCALES))
        images = [resampled(photo, scale), *(renderer(camera).rgb for renderer in renderers)]
        y, x = slice(top * times, bottom * times), slice(left * times, right * times)
        rows.append((scale, [image[y, x] for image in images]))
    return contact_sheet(COLUMNS, rows)
