"""What web viewers draw of the bundled chair: PSNR against photographs and against aaplug's prediction.

It needs Node.js, npm and Chromium.  Each row of `VIEWERS` that a page here can show draws the original and the scene
converted for it, at four sizes.  A cell has PSNR in dB against the photographs and, in brackets, against aaplug's own
render by the row's rule, which is the prediction.  Where anti-aliasing must be turned on, a third row has the converted
scene with it off.
"""

import csv
import json
import os
import shutil
import statistics
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from math import atan, degrees
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import Camera, CameraSet, Gaussians, Renderer, TrainingViews, convert, read_cameras, read_image
from aaplug.core.colours import WHITE
from aaplug.core.imaging import quantised, resampled
from aaplug.core.orbits import frame_of
from aaplug.io.photographs import read_photo
from aaplug.io.scenes import read_scene, write_scene
from aaplug.io.streamed import STREAMS, write_index, write_level
from aaplug.methods.conversion import fuse_for
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import VIEWERS, Viewer
from tests.bench import heading, row
from tests.bench.method_tables import TABLES, keep
from tests.bench.scenes import decibels

FOLDER = Path(__file__).with_name("viewer_pages")
TILES = STREAMS["3dtiles"].index
SCALES = (1.0, 0.5, 0.25, 0.125)
VIEWS = 2
COMMAND = "python -m tests.bench viewers --steps 0"
PAGE_SECONDS = 300.0  # that a page may take for one thing
OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # from OpenCV's axes


@dataclass(frozen=True)
class Page:
    """How a page shows a viewer's row, of which file.

    off: the options with anti-aliasing off, where it is off by default.
    """

    name: str
    options: Mapping[str, Any]
    off: Mapping[str, Any] | None = None
    file: str = "scene.ply"

    def shot(
        self, scene: Gaussians, shown: Path, views: Mapping[Any, Camera], work: Path
    ) -> dict[Any, Float[Tensor, "h w 3"]]:
        """What it draws of a scene, by view.  shown, work: folders of the scene and of the pictures."""
        shown.mkdir(parents=True, exist_ok=True)
        if self.file == TILES:
            write_level(shown, "3dtiles", 0, [scene])  # as one tile
            write_index(shown, "3dtiles", 1, 1.0, frame_of(scene))
        else:
            write_scene(shown / self.file, scene, overwrite=True)
        return shoot(self.name, shown, self.file, self.options, views, work)


def _mkkellogg(**options: Any) -> Page:
    usual = {"sphericalHarmonicsDegree": 2}
    return Page("mkkellogg", usual | options, usual if options else None)


PAGES = {
    "spark": Page("spark", {}),
    "spark-mip": Page("spark", {"blurAmount": 0.1}),
    "spark-classic": Page("spark", {"preBlurAmount": 0.3, "blurAmount": 0}),
    "playcanvas": Page("playcanvas", {"antiAlias": True}, {"antiAlias": False}),
    "playcanvas-classic": Page("playcanvas", {"antiAlias": False}),
    "babylon": Page("babylon", {"Compensation": True}, {"Compensation": False}),
    "babylon-classic": Page("babylon", {"Compensation": False}),
    "cesium": Page("cesium", {}, file=TILES),
    "khr in Babylon.js": Page("babylon", {}, file="scene.glb"),
    "khr in CesiumJS": Page("cesium", {}, file=TILES),
    "mkkellogg": _mkkellogg(antialiased=True),
    "mkkellogg-mip": _mkkellogg(antialiased=True, kernel2DSize=0.1),
    "mkkellogg-classic": _mkkellogg(),
}


def main(
    work: Path = Path("out/viewers"), steps: int | None = None, views: int = VIEWS, rows: Sequence[str] = tuple(PAGES)
) -> None:
    """Print the table; of the closed forms and the usual views, put it into tables/viewers.csv, too.

    Args:
        work: folder of converted scenes and pictures.
        steps: of the conversions; 0 takes the closed forms, which are quick.
        views: their number.
        rows: of the table.
    """
    if not (FOLDER / "node_modules").exists():
        subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--silent"], cwd=FOLDER, check=True)
    work.mkdir(parents=True, exist_ok=True)
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply").gaussians(), read_cameras(sample)
        bench = Bench(work.resolve(), scene, cameras, cameras.test[:views], steps)
        sizes = [str(round(bench.views[0].width * scale)) for scale in SCALES]
        heading("viewers", "`--for`", "scene", *sizes)
        measured = list[list[str]]()
        for name in rows:
            for label, cells in bench.rows(VIEWERS[name.split()[0]], PAGES[name]):
                row(f"`{name}`", label, *cells)
                measured.append([name, label, *cells])
        if steps == 0 and views == VIEWS:
            kept = [line for line in results() if line[0] not in rows] + measured
            kept.sort(key=lambda line: list(PAGES).index(line[0]))
            keep("viewers", [["for", "shown", *sizes], *kept], COMMAND)


def results() -> list[list[str]]:
    """The lines of viewers.csv."""
    with open(TABLES / "viewers.csv", newline="", encoding="utf-8") as file:
        return list(csv.reader(file))[1:]


def shown_table() -> str:
    """viewers.csv as Markdown."""
    lines = [["`--for`", "shown", "800", "400", "200", "100"], ["---"] * 6]
    lines += [[f"`{name}`", *cells] for name, *cells in results()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace(" --- ", "---")


@dataclass(frozen=True)
class Bench:
    """What every picture needs.  views: the test views that are shown, all square."""

    work: Path
    scene: Gaussians
    cameras: CameraSet
    views: Sequence[Camera]
    steps: int | None

    def converted(self, viewer: Viewer) -> Gaussians:
        """The scene for a viewer; made once for each rule and degree."""
        assert viewer.convention is not None
        path = self.work / f"{viewer.convention.name}-{viewer.sh_degree}.ply"
        if not path.exists():
            if self.steps == 0:  # `convert` would measure it too
                scene = fuse_for(self.scene, TrainingViews.of(self.scene, self.cameras), viewer)
            else:
                scene = convert(self.scene, self.cameras, viewer=viewer, steps=self.steps).scene
                assert scene is not None
            write_scene(path, scene)
        return read_scene(path).gaussians()

    def rows(self, viewer: Viewer, page: Page) -> Iterator[tuple[str, list[str]]]:
        """The rows of a viewer: what is shown, and a cell per scale."""
        converted = self.converted(viewer)
        yield "original", self.cells(viewer, self.scene, page)
        if converted.fused:
            yield "converted", self.cells(viewer, converted, page)
        if page.off is not None:
            yield "converted, anti-aliasing off", self.cells(None, converted, replace(page, options=page.off))

    def cells(self, viewer: Viewer | None, scene: Gaussians, page: Page) -> list[str]:
        """PSNR against photographs at each scale and, for a viewer, against its prediction."""
        views = {(v.name, s): v.scaled(s) for v in self.views for s in SCALES}
        pictures = page.shot(scene, self.work / "shown", views, self.work)
        cells = []
        for scale in SCALES:
            drawn = [pictures[view.name, scale] for view in self.views]
            photos = [_photograph(view, scale) for view in self.views]
            cell = f"{_mean(drawn, photos):.2f}"
            if viewer is not None:
                own = Renderer.of(viewer.shown(scene), self.cameras, recipe_of(viewer), background=WHITE)
                predicted = [quantised(own(view.scaled(scale)).rgb) for view in self.views]
                cell += f" ({_mean(drawn, predicted):.1f})"
            cells.append(cell)
        return cells


def shoot(
    page: str, folder: Path, url: str, options: Mapping[str, Any], views: Mapping[Any, Camera], work: Path
) -> dict[Any, Float[Tensor, "h w 3"]]:
    """What a page draws of a file of a folder, by view.  work: folder of the pictures."""
    work.mkdir(parents=True, exist_ok=True)
    files = {key: (work / f"{place}.png").resolve() for place, key in enumerate(views)}
    shots = [_shot(view) | {"file": str(files[key])} for key, view in views.items()]
    facts = {"page": page, "scene": str(folder.resolve()), "url": url, "options": options, "shots": shots}
    job = work / "job.json"
    job.write_text(json.dumps(facts | {"seconds": PAGE_SECONDS, "chromium": _chromium()}))
    subprocess.run(["node", str(FOLDER / "run.mjs"), str(job)], check=True)
    return {key: read_image(file, WHITE) for key, file in files.items()}


def _shot(camera: Camera) -> dict[str, Any]:
    """A camera as the pages take it: field of view in degrees, pose from the world's axes in OpenGL's."""
    assert camera.width == camera.height, "the pages show squares"
    pose = torch.linalg.inv(camera.cam_from_world.double()) @ OPENGL
    fov = degrees(2 * atan(camera.height / 2 / camera.fy))
    return {"size": camera.width, "fov": fov, "pose": pose.tolist()}


def _photograph(view: Camera, scale: float) -> Float[Tensor, "h w 3"]:
    assert view.photo is not None
    return quantised(resampled(read_photo(view.photo, WHITE), scale))


def _mean(images: Sequence[Float[Tensor, "h w 3"]], truths: Sequence[Float[Tensor, "h w 3"]]) -> float:
    return statistics.fmean(map(decibels, images, truths))


def _chromium() -> str:
    program = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        raise SystemExit("no Chromium; install it, or set CHROMIUM to its path")
    return program
