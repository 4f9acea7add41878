"""The whole job on the bundled sample: a pretrained chair and four photographs."""

from importlib.resources import as_file, files
from pathlib import Path

from aaplug.core.colours import WHITE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.report.contact_sheet import sheet_of
from aaplug.evaluation.report.files import RESULTS
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth
from aaplug.io.atomic import AnyPath, output_folder, refuse_existing
from aaplug.io.cameras import read_cameras
from aaplug.io.images import write_png
from aaplug.io.scenes import read_scene
from aaplug.rendering.renderer import Renderer
from aaplug.system.contracts import contract
from aaplug.system.monitor import SILENT, Monitor
from aaplug.verbs.convert import convert
from aaplug.verbs.evaluate import evaluate

SCALES = (1.0, 0.5, 0.25, 0.125)
SHEET_VIEW = "r_136"
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
        training, converted = TrainingViews.of(scene, cameras), read_scene(folder / CONVERTED).gaussians()
        drawn = {
            "classic 3DGS": Renderer.of(scene, training, "classic", background=WHITE),
            "aaplug": Renderer.of(scene, training, "auto", background=WHITE),
            "converted .ply, Mip viewer": Renderer.of(converted, training, "mip", background=WHITE),
        }
        sheet = sheet_of(Truth(drawn["aaplug"], "photographs"), view, SCALES, drawn, "photograph")
        write_png(folder / SHEET, sheet, overwrite=overwrite)
        monitor.say(f"wrote {folder / SHEET}")
        how = {"scale": SCALES, "metric": ("psnr", "ssim"), "name": "chair"}
        return evaluate(scene, cameras, folder, overwrite=overwrite, monitor=monitor, **how)
