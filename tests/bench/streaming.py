"""Streamed levels in their viewers: dB against the scene's own look from 1 to 1/16, ours and others'.

It needs Node.js 22, npm and Chromium.  `aaplug lod --to` makes our levels; splat-transform (`-g cpu --decimate`) makes
scenes of as many Gaussians, which are cut and indexed in the same way, so that both show equally many.  Beside a .rad
is the tree that Spark itself makes of the scene; its page says how many splats each picture shows.  A cell has PSNR
in dB between the viewer's picture and the scene's own training-size render, averaged over boxes.

The last columns tell of a camera that moves out, as root mean squares in steps of 8 bits: the largest change between
two frames in turn, and the largest change of what the frames differ by from the scene's own (recipe `auto`, `best`).
The first row has the change of the scene's own frames.  It is the motion itself: a right picture changes no less.
"""

import json
import math
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

import aaplug
from aaplug import Gaussians, write_scene
from aaplug.core.camera_paths import median_depth, moved
from aaplug.core.colours import WHITE
from aaplug.core.imaging import quantised, resampled
from aaplug.core.orbits import frame_of
from aaplug.core.pyramids import Level
from aaplug.core.sampling import median_rates
from aaplug.io import StreamName
from aaplug.io.streamed import SETTINGS, STREAMS, write_index, write_level
from tests.bench import heading, row, scenes
from tests.bench.scenes import decibels
from tests.bench.viewers import shoot
from tests.conftest import SAMPLE

SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)
PAGES = {"sog": "playcanvas", "3dtiles": "cesium", "rad": "spark"}
FURTHEST = 16.0  # times the training distance, at the last frame
MOVING_SIZE = 0.5  # of the training size, of the frames
SPLAT_TRANSFORM = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def main(
    scene: Path = SAMPLE / "chair.ply",
    cameras: Path = SAMPLE,
    to: Sequence[StreamName] = ("sog", "3dtiles", "rad"),
    work: Path = Path("out/streaming"),
    modules: Path = Path("tests/bench/viewer_pages"),
    node: str = "node",
    levels: int | None = None,
    steps: int | None = None,
    views: int = 2,
    frames: int = 120,
    split: bool = False,
) -> None:
    """Print the table.

    Args:
        scene: a scene file.
        cameras: its data set.
        to: what to stream.
        work: folder of levels and pictures; levels that are there are kept.
        modules: folder of node_modules.
        node: Node.js of version 22 or later.
        levels: coarser levels; see `aaplug lod`.
        steps: of the tuning, as there.
        views: their number.
        frames: of the camera that moves out; 0 for none.
        split: each Gaussian into 20, for a large scene that looks alike.
    """
    heading(
        "streaming", "streamed", "levels", *(f"1/{1 / scale:g}" for scale in SCALES), "largest change", "of the error"
    )
    whole, data = aaplug.read_scene(scene).gaussians(), aaplug.read_cameras(cameras)
    if split:
        whole, scene = scenes.split(whole), work / "split.ply"
        write_scene(scene, whole, overwrite=True)
    seen = data.test[:: max(1, len(data.test) // views)][:views]
    look = aaplug.Renderer.of(whole, data, "classic", background=WHITE)
    truths = {view.name: look(view).rgb for view in seen}
    sized = {(view.name, scale): view.scaled(scale) for view in seen for scale in SCALES}
    start, depth = seen[0].scaled(MOVING_SIZE), median_depth(whole.means, seen[0])
    out = [moved(start, FURTHEST ** -(t / max(1, frames - 1)), depth) for t in range(frames)]
    still = aaplug.Renderer.of(whole, data, "auto", quality="best", background=WHITE)
    own = [quantised(still(frame).rgb) for frame in out]
    row("", "the scene itself", *[""] * len(SCALES), _largest_change(own), "")
    rates = median_rates(whole.means, data.train)
    for name in to:
        index, ours, theirs = STREAMS[name].index, work / f"{name}-ours", work / f"{name}-theirs"
        if not (ours / index).exists():
            aaplug.lod(whole, data, ours, to=name, levels=levels, steps=steps, resume=(ours / "lod.json").exists())
        options = _options(name, json.loads((ours / SETTINGS).read_text()))
        shown = {"ours": (ours, index, options)}
        if name == "rad":
            theirs.mkdir(exist_ok=True)
            write_scene(theirs / "scene.ply", whole, overwrite=True)
            shown["Spark's own tree"] = theirs, "scene.ply", options | {"mesh": {"lod": "quality"}}
        elif not (theirs / index).exists():
            facts = json.loads((ours / index).read_text())
            command = [node, str((modules / SPLAT_TRANSFORM).resolve()), "-g", "cpu", str(scene)]
            counts = facts.get("counts") or facts["asset"]["extras"]["counts"]
            lighter = list(_decimated(whole, counts, work, command))
            for number, level in enumerate(lighter):
                write_level(theirs, name, number, [level.scene])
            write_index(theirs, name, len(lighter), float(rates[rates > 0].median()), frame_of(lighter[0].scene))
        if name != "rad":
            shown["splat-transform"] = theirs, index, options
        if name == "sog":
            shown["splat-transform, anti-aliasing off"] = theirs, index, options | {"antiAlias": False}
        for label, (folder, file, how) in shown.items():
            pictures = work / f"{name}-{len(label)}"
            drawn = shoot(PAGES[name], folder, file, how, sized | dict(enumerate(out)), pictures)
            averaged = {(v.name, s): quantised(resampled(truths[v.name], s)) for v in seen for s in SCALES}
            cells = [fmean(decibels(drawn[v.name, s], averaged[v.name, s]) for v in seen) for s in SCALES]
            moving = [drawn[t] for t in range(frames)]
            errors = [image - truth for image, truth in zip(moving, own, strict=True)]
            row(name, label, *cells, _largest_change(moving), _largest_change(errors))


def _decimated(whole: Gaussians, counts: Sequence[int], work: Path, command: Sequence[str]) -> Iterator[Level]:
    """splat-transform's scenes of so many Gaussians, as levels of one part of space."""
    for number, count in enumerate(counts):
        file, lighter = work.resolve() / f"decimated-{count}.ply", whole
        if count < len(whole):
            subprocess.run([*command, "--decimate", str(count), str(file), "-w", "-q"], check=True)
            lighter = aaplug.read_scene(file).gaussians()
        yield Level(lighter, 0.5**number, torch.zeros(len(lighter), dtype=torch.long))


def _options(name: StreamName, settings: Mapping[str, Any]) -> dict[str, Any]:
    """settings.json as the page takes it."""
    if name == "3dtiles":
        return settings["Cesium3DTileset"]
    if name == "rad":
        return settings["SparkRenderer"]
    engine, component, distance, *_ = settings.values()
    return {**engine, "component": component, "distancePerPixel": distance}


def _largest_change(frames: Sequence[Float[Tensor, "h w 3"]]) -> float:
    """Root mean square between two frames in turn, in steps of 8 bits; NaN without two."""
    return max((float((b - a).square().mean().sqrt()) * 255 for a, b in pairwise(frames)), default=math.nan)
