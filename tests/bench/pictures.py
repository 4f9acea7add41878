"""The pictures of examples/guides: two figures of one Gaussian, PSNR over scale, and the gallery's images."""

import math
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from aaplug import Camera, CameraSet, Gaussians, Renderer, TrainingViews, look_at, read_cameras, read_scene
from aaplug.core.colours import WHITE
from aaplug.core.imaging import resampled
from aaplug.core.lenses import EQUIDISTANT, ORTHO, opencv_lens
from aaplug.evaluation.report.plots import COLOURS, MARKERS, Plot
from aaplug.evaluation.results import CEILING, scale_name
from aaplug.io.images import encoded, read_image
from tests.bench.concepts import concepts
from tests.bench.film_lenses import panorama
from tests.bench.method_tables import PSNR_COLUMN, Table, table
from tests.bench.room import furnished, inside
from tests.bench.theory import laws

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "guides" / "pictures"
TITLES = {
    "chair": "the chair, trained at 800×800",
    "snowmiku": "the capture, trained at 984×740",
    "chair-eighth": "the chair, trained at 100×100, enlarged",
    "snowmiku-quarter": "the capture, trained at 246×185, enlarged",
}
CURVES = ("auto", "classic", "mip", "mip-splatting", "sa-gs", "matched", "gaussian-blending", "2dgs-matched")
SCALES_SIZE = (10, 7.4)  # inches
PHOTOGRAPH = "photograph"
GALLERY = (  # a view, its scale, and recipes that draw it
    ("r_136", 1 / 4, ("classic", "mip", "auto", PHOTOGRAPH)),
    ("r_136", 1 / 8, ("classic", "auto", PHOTOGRAPH)),
    ("r_24", 1 / 8, ("classic", "auto")),
    ("r_136", 4.0, ("classic", "auto")),
)
PANORAMA = 1024  # px: width, a quarter of that at the room's training rate
MARGIN = 0.02  # of the image, around what is opaque
DETAIL_CENTRE, DETAIL_SIDE = (0.46, 0.68), 0.2  # shares of an enlarged view, of which only this is kept
ENLARGED_QUALITY = 80  # WebP: an enlarged view is smooth


def main() -> None:
    """Write all pictures."""
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply").gaussians(), read_cameras(sample)
        pictures = {f"{plot.name}.svg": plot.svg().encode() for plot in (*concepts(scene, cameras), scales(), laws())}
        pictures |= gallery(scene, cameras)
        pictures["lenses.webp"] = encoded(".webp", lenses(scene), ENLARGED_QUALITY)
        pictures |= {f"panorama-{recipe}.webp": around(scene, recipe) for recipe in ("classic", "auto")}
    for name, content in pictures.items():
        (FOLDER / name).write_bytes(content)
        print(f"{FOLDER.name}/{name}: {len(content):,} bytes")


def lenses(chair: Gaussians) -> Float[Tensor, "h w 3"]:
    """A room with the chair: a panorama, and below it a fisheye of 180°, an orthographic and a distorted view."""
    renderer = Renderer.of(furnished(chair), inside(), "auto", min_seen=0)
    eye, up = torch.tensor([0.6, -2.3, -1.3]), torch.tensor([0.0, 0.0, 1.0])
    level, down = (look_at(eye, torch.tensor([0.0, 0.0, height]), up) for height in (-1.3, -1.9))
    side = 340  # px
    middle = {"width": side, "height": side, "cx": side / 2, "cy": side / 2}
    views = (  # focal length in px, and pose
        (replace(EQUIDISTANT, max_angle=90.0), side / math.pi, level),
        (ORTHO, side / 4, down),
        (opencv_lens((-0.25, 0.06)), side / 2, down),
    )
    below = [
        renderer(Camera("view", **middle, fx=focal, fy=focal, cam_from_world=pose, lens=lens)).rgb
        for lens, focal, pose in views
    ]
    return torch.cat([renderer(panorama(level, 3 * side)).rgb, torch.cat(below, dim=1)]).clamp(0, 1)


def around(chair: Gaussians, recipe: str) -> bytes:
    """A panorama of the furnished room at 1/4 of the rate that its cameras trained at."""
    eye, ahead, up = torch.tensor([0.6, -2.3, -1.3]), torch.tensor([0.0, 0.0, -1.3]), torch.tensor([0.0, 0.0, 1.0])
    renderer = Renderer.of(furnished(chair), inside(), recipe, min_seen=0)
    return encoded(".webp", renderer(panorama(look_at(eye, ahead, up), PANORAMA)).rgb.clamp(0, 1), ENLARGED_QUALITY)


def scales() -> Plot:
    """PSNR over scale from the tables of methods.md: a curve per recipe, and a panel per table."""
    return Plot("scales", "PSNR over scale, one line per recipe and one panel per scene", _scales_figure)


def _scales_figure(ink: str) -> Figure:
    figure = Figure(SCALES_SIZE, layout="constrained")
    panels = figure.subplots(2, 2).flat
    for axes, (scene, title) in zip(panels, TITLES.items(), strict=True):
        curves(axes, table(scene), ink)
        axes.set_title(title)
        axes.set_ylabel("PSNR, dB")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def curves(axes: Axes, lines: Table, ink: str) -> None:
    """PSNR over scale of a table, a line per recipe."""
    at = sorted({scale for _, scale in lines})
    for recipe, colour, marker in zip(CURVES, COLOURS, MARKERS, strict=False):
        values = [float(lines[recipe, scale][PSNR_COLUMN]) for scale in at]
        width, layer = (2.4, 3) if recipe == "auto" else (1.2, 2)
        axes.plot(at, values, marker=marker, ms=5, lw=width, color=colour, label=recipe, zorder=layer)
    ceiling = [float(lines[CEILING, scale][PSNR_COLUMN]) for scale in at]
    axes.plot(at, ceiling, color=ink, ls=(0, (4, 3)), lw=1, label=CEILING, zorder=1)
    axes.set_xscale("log", base=2)
    axes.set_xticks(at, [scale_name(scale) for scale in at])
    axes.minorticks_off()
    axes.grid(axis="y", color=ink, alpha=0.12)


def gallery(scene: Gaussians, cameras: CameraSet) -> dict[str, bytes]:
    """Files by name, chair-VIEW-PIXELS-RECIPE.webp: views rendered smaller and larger, and photographs made smaller."""
    training, images = TrainingViews.of(scene, cameras), {}
    views = {view.name: view for view in cameras.test}
    for name, scale, recipes in GALLERY:
        camera = views[name].scaled(scale)
        drawn = {recipe: _drawn(scene, training, views[name], camera, recipe) for recipe in recipes}
        y, x = _detail(camera) if scale > 1 else _opaque(drawn["auto"])
        quality = ENLARGED_QUALITY if scale > 1 else None
        for recipe, image in drawn.items():
            images[f"chair-{name}-{camera.width}-{recipe}.webp"] = encoded(".webp", image[y, x], quality)
    return images


@torch.no_grad()
def _drawn(
    scene: Gaussians, training: TrainingViews, view: Camera, camera: Camera, recipe: str
) -> Float[Tensor, "h w 3"]:
    if recipe == PHOTOGRAPH:
        assert view.photo is not None
        return resampled(read_image(view.photo, WHITE), camera.width / view.width)
    return Renderer.of(scene, training, recipe, background=WHITE)(camera).rgb


def _opaque(image: Float[Tensor, "h w 3"]) -> tuple[slice, slice]:
    """Rows and columns that are not background, with a margin."""
    ink = (image < 1 - 1 / 255).any(dim=2)
    margin = round(MARGIN * len(image)) + 1
    sides = [ink.any(dim=side).nonzero() for side in (1, 0)]
    rows, columns = (slice(max(0, int(side.min()) - margin), int(side.max()) + 1 + margin) for side in sides)
    return rows, columns


def _detail(camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of an enlarged view that are kept."""
    (x, y), half = DETAIL_CENTRE, DETAIL_SIDE / 2
    spans = ((y, camera.height), (x, camera.width))
    rows, columns = (slice(round((at - half) * side), round((at + half) * side)) for at, side in spans)
    return rows, columns
