"""The film camera: passes and files, lenses, aperture and shutter; `kills` has frame sequences."""

import math
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

import aaplug
from aaplug.core.imaging import levels
from aaplug.core.passes import PASSES
from aaplug.evaluation.report.contact_sheet import labelled
from aaplug.io.image_formats import Storage
from aaplug.io.images import read_rgba, write_png
from aaplug.io.layers import write_layers
from tests.bench import film_aperture, film_lenses, heading, row, timed
from tests.conftest import SAMPLE, make_camera, make_scene
from tests.test_passes import plane_errors

COLUMNS = 5  # of the contact sheet
PLANE_PASSES = ("depth", "depth-median", "depth-nearest")
PRIME = 7919  # scatters the colours of neighbouring ids


def shown(name: str, drawn: dict[str, Tensor]) -> Tensor:
    """A pass as colours, for looking at it: gray from its 2nd to its 98th percentile, axes as red, green and blue."""
    layer, covered = drawn[name].double(), drawn["alpha"] > 0.5
    if name in ("rgb", "alpha"):
        return drawn[name].float() if name == "rgb" else drawn[name][..., None].expand(-1, -1, 3)
    if name == "normal":
        return ((layer + 1) / 2 * covered[..., None]).float()
    if name == "id":
        layer = torch.stack([(layer * PRIME * k) % 256 for k in (1, 3, 7)], dim=2) / 255
        return (layer * (drawn["id"] >= 0)[..., None]).float()
    layer = layer if layer.ndim == 3 else layer[..., None].expand(-1, -1, 3)
    inside = layer[covered]
    low, high = (inside.quantile(q, dim=0) for q in (0.02, 0.98))
    gray = (layer - low) / (high - low).clamp(min=1e-9)
    return (gray.clamp(0, 1) * (covered if name != "samples" else torch.ones_like(covered))[..., None]).float()


def contact_sheet(scale: float = 0.5) -> Tensor:
    """Every pass of a view of the sample, with its name."""
    cameras = aaplug.read_cameras(SAMPLE)
    drawn = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras).passes(cameras.test[0].scaled(scale), list(PASSES))
    panes = [labelled(shown(name, drawn).contiguous(), name) for name in PASSES]
    rows = [torch.cat(panes[start : start + COLUMNS], dim=1) for start in range(0, len(panes), COLUMNS)]
    return torch.cat(rows)


def cost_of_passes() -> None:
    """The time of each pass, over that of rgb alone."""
    cameras = aaplug.read_cameras(SAMPLE)
    renderer, view = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras), cameras.test[0]
    heading(
        f"Time of passes over rgb, the sample at {view.width}x{view.height} px ({renderer.rasterizer.name})",
        "passes",
        "times rgb",
    )

    several = {"rgb": ["rgb"], "rgb alpha": ["rgb", "alpha"], **{n: [n] for n in PASSES if n not in ("rgb", "alpha")}}
    several["all"] = list(PASSES)
    times = timed({name: partial(renderer.passes, view, names) for name, names in several.items()}, 3, min)
    alone = times.pop("rgb")
    for name, seconds in times.items():
        row(name, seconds / alone)


def truth_of_passes() -> None:
    """Errors of depth, normal and position of a textured plane at several tilts, and of alpha."""
    heading(f"A textured plane of {120**2:,} discs, largest error", "tilt", "size", *PLANE_PASSES, "position", "normal")
    for tilt, scale in product((0, 35, 60, 75), (1.0, 0.25)):
        error = plane_errors(math.radians(tilt), scale)
        row(
            f"{tilt}°",
            f"{scale:g}",
            *(f"{error[name]:.3%}" for name in (*PLANE_PASSES, "position")),
            f"{error['normal']:.2f}°",
        )
    scene, camera = make_scene(300), make_camera((0.0, -4.0, 0.3), (64, 48))
    drawn = [aaplug.Renderer.of(scene, [camera], "classic", rasterizer=name) for name in ("auto", "reference")]
    alpha, exact = (renderer.passes(camera, ["alpha"])["alpha"].double() for renderer in drawn)
    heading("Alpha against 1 - transmittance in float64", "largest error")
    row(f"{(alpha - exact).abs().max():.1e}")


def straight_files() -> None:
    """RGBA files over a background against the opaque image."""
    cameras = aaplug.read_cameras(SAMPLE)
    heading(
        "The sample over green, of files with alpha, against the opaque image",
        "file",
        "largest, 8-bit levels",
        "above 1 level",
    )
    background = (0.2, 0.9, 0.4)
    opaque = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras, background=background)(cameras.test[0]).rgb
    drawn = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras, background="black")(cameras.test[0])._asdict()
    with tempfile.TemporaryDirectory() as folder:
        for name in ("a.png", "a.exr"):
            path = Path(folder) / name
            write_layers(path, drawn, Storage.of(path, passes=("rgb", "alpha"), colour="srgb"))
            rgb, alpha = channels_of_file(path)
            off = (levels(rgb + (1 - alpha) * torch.tensor(background), 8) - levels(opaque, 8)).abs()
            row(name, int(off.max()), f"{(off > 1).double().mean():.3%}")


def channels_of_file(path: Path) -> tuple[Tensor, Tensor]:
    """Premultiplied colours, and alpha, [h, w, 1]."""
    if path.suffix == ".png":
        rgba = read_rgba(path)
        return rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]
    import OpenEXR

    rgba = torch.from_numpy(OpenEXR.File(str(path)).channels()["RGBA"].pixels.astype("float32"))
    return rgba[..., :3], rgba[..., 3:]


LINES: list[Callable[[], None]] = [truth_of_passes, straight_files, cost_of_passes]


def main(pictures: Path | None = None, only: Literal["passes", "lenses", "aperture"] | None = None) -> None:
    """Print every table.

    Args:
        pictures: folder for the contact sheet of the sample's passes, and for what aperture and shutter draw.
        only: tables of one kind.
    """
    if only in (None, "lenses"):
        film_lenses.main()
    if only in (None, "aperture"):
        film_aperture.main(pictures=pictures)
    if only not in (None, "passes"):
        return
    if pictures is not None:
        write_png(pictures / "passes.png", contact_sheet(), overwrite=True)
    for line in LINES:
        line()
