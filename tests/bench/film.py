"""Passes and files of the film camera: the time of each pass, and files with alpha against opaque images.

`film_lenses` and `film_aperture` have the others, `kills` has frame sequences.
"""

import tempfile
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import aaplug
from aaplug.core.imaging import levels
from aaplug.core.passes import PASSES
from aaplug.io.image_formats import Storage
from aaplug.io.images import read_rgba
from aaplug.io.layers import write_layers
from tests.bench import heading, row, timed
from tests.conftest import SAMPLE


def cost_of_passes() -> None:
    """The time of each pass, over that of rgb alone."""
    cameras = aaplug.read_cameras(SAMPLE)
    renderer, view = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras), cameras.test[0]
    title = f"Time of passes over rgb, the sample at {view.width}x{view.height} px ({renderer.rasterizer.name})"
    heading(title, "passes", "times rgb")
    several = {"rgb": ["rgb"], "rgb alpha": ["rgb", "alpha"], **{n: [n] for n in PASSES if n not in ("rgb", "alpha")}}
    several["all"] = list(PASSES)
    times = timed({name: partial(renderer.passes, view, names) for name, names in several.items()}, 3, min)
    alone = times.pop("rgb")
    for name, seconds in times.items():
        row(name, seconds / alone)


def straight_files() -> None:
    """RGBA files over a background against the opaque image."""
    cameras = aaplug.read_cameras(SAMPLE)
    title = "The sample over green, of files with alpha, against the opaque image"
    heading(title, "file", "largest, 8-bit levels", "above 1 level")
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


def main() -> None:
    """Print both tables."""
    straight_files()
    cost_of_passes()
