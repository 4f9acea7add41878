"""The files of a comparison of scenes: compare.json, compare.csv, report.html and contact-sheet.png."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.comparison import Comparison
from aaplug.evaluation.engine import Task
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metric import Image, TimedRenderer
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.report.contact_sheet import contact_sheet, error_map
from aaplug.evaluation.report.files import as_json, write_page, write_texts
from aaplug.evaluation.results import as_csv, scale_name
from aaplug.evaluation.truth import ViewTruth
from aaplug.inspection.coverage import Coverage
from aaplug.io.images import write_png

NAME = "compare"
TEXTS, SHEET = (f"{NAME}.json", f"{NAME}.csv"), "contact-sheet.png"
COMPARED = (*TEXTS, SHEET)


def write_comparison(
    found: Comparison, task: Task, folder: Path, bounds: Coverage, images: ImageStore, overwrite: bool
) -> list[Path]:
    """Write the files and return their paths.  bounds: of the reference.  images: those that the page shows."""
    texts = dict(zip(TEXTS, (as_json(found.summary()), as_csv({NAME: found.report})), strict=True))
    written = write_texts(folder, texts, overwrite)
    title = f"{found.reference.name} and {', '.join(scene.name for scene in found.scenes[1:])}"
    written += write_page(folder, title, found.report, bounds, images, overwrite, found.cells())
    write_png(folder / SHEET, sheet(found, task), overwrite=overwrite)
    return [*written, folder / SHEET]


def sheet(found: Comparison, task: Task) -> Float[Tensor, "H W 3"]:
    """The worst view at every scale: the truth, then every other scene and the map of its errors."""
    others = [candidate for candidate in task.candidates if candidate.name != found.reference.name]
    columns, rows = [_ascii(found.reference.name)], []
    for other in others:
        columns += [_ascii(other.name), "error"]
    truth = ViewTruth(task.truth, task.views[_worst_view(found)])
    drawers = [TimedRenderer(other.renderer) for other in others]
    for scale in sorted(task.scales, reverse=True):
        expected, shown = truth.image(scale), list[Image]()
        assert expected is not None
        for drawer in drawers:
            image = drawer(truth.camera(scale)).rgb
            shown += [image, error_map(image, expected)]
        rows.append((_ascii(scale_name(scale)), [expected, *shown]))
    return contact_sheet(columns, rows)


def _worst_view(found: Comparison) -> int:
    """Place of the view with the lowest PSNR of all; the first where all images are equal."""
    others = [m for m in found.report.measurements if m.recipe != found.reference.name]
    known = [(value, m.view) for m in others if (value := m.values.get(PSNR.name)) is not None]
    return found.report.protocol["view_names"].index(min(known)[1]) if known else 0


def _ascii(text: str) -> str:
    return text.replace("×", "x").encode("ascii", "replace").decode()
