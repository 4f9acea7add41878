"""Defocus and motion blur by few samples against 1024, and what they cost."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import torch

from aaplug import Aperture, Camera, Exposure, Renderer, read_cameras, write_png
from aaplug.core import exposures
from aaplug.core.camera_paths import orbit
from aaplug.evaluation.metrics import psnr
from tests.bench import heading, row, timed
from tests.bench.scenes import CHECKPOINTS, trained
from tests.conftest import SAMPLE, SHARED_DATA

SCENES = ("sample", "chair", "snowmiku")
RADII = (2, 5, 10, 20, 40)  # px: of the largest circles of confusion, those of the farthest 1 % of the splats
LENGTHS = (5, 10, 20, 40)  # px: median length of the splats' ways while the shutter is open
NEAREST, FARTHEST = 0.1, 0.99  # quantiles of depth: in focus, and of the largest circle
TRUTH = 1024  # samples


def main(
    scenes: Sequence[str] = SCENES, scale: float = 0.5, views: int = 5, rounds: int = 3, pictures: Path | None = None
) -> None:
    """Print figures of scenes: the sample, and trained ones where they are there.

    scale: of the images, against training's.  views: test views of each scene.  rounds: of the timing.
    pictures: a folder for the images.
    """
    for name in scenes:
        if name == SCENES[0]:
            dataset = read_cameras(SAMPLE)
            aperture(name, Renderer.of(SAMPLE / "chair.ply", dataset), dataset.test[:views], scale, rounds, pictures)
        elif (SHARED_DATA / CHECKPOINTS[name].file).exists():
            opened = trained(name)
            aperture(name, opened.renderer(), opened.views(views), scale, rounds, pictures)


@torch.no_grad()
def aperture(
    name: str, renderer: Renderer, views: Sequence[Camera], scale: float, rounds: int, pictures: Path | None
) -> None:
    """Figures of views of a scene: PSNR in dB against 1024 samples, and time against separate frames."""
    chosen = [camera.scaled(scale) for camera in views]
    for kind, steps, exposure in (("defocus", RADII, _aperture), ("motion", LENGTHS, _motion)):
        heading(f"{name}, {kind}: dB from {TRUTH} samples", "px", "1", "5", "16", "16 plain", "pinhole", "time")
        for size in steps:
            figures: list[list[float]] = []
            for view in chosen:
                of = exposure(renderer, view, size)
                truth = renderer(of(TRUTH)).rgb
                images = {str(n): renderer(of(n)).rgb for n in (1, 5, 16)}
                # samples stand for points, as plain supersampling's do
                with patch.object(exposures, "cells", lambda splats, _: torch.zeros_like(splats.covs)):
                    images["16 plain"] = renderer(of(16)).rgb
                images["pinhole"] = renderer(view).rgb
                works = {"one": partial(renderer, of(16)), "separate": partial(_separate, renderer, of(16))}
                times = timed(works, rounds)
                ratio = times["one"] / times["separate"]
                figures.append([*(psnr(image, truth) or math.inf for image in images.values()), ratio])
                if pictures is not None:
                    for word, image in {**images, "truth": truth}.items():
                        write_png(pictures / f"{name}-{kind}-{size}-{word}.png", image, overwrite=True)
            row(size, *(f"{sum(column) / len(column):.2f}" for column in zip(*figures, strict=True)))


def _aperture(renderer: Renderer, view: Camera, radius: float) -> Callable[[int], Camera]:
    """The view with so many samples of an aperture that makes circles of this radius (px)."""
    depths = renderer.splats(view).depths
    focus, far = float(depths.quantile(NEAREST)), float(depths.quantile(FARTHEST))
    opening = Aperture(radius / (view.fx * (1 / focus - 1 / far)), focus)
    return lambda samples: replace(view, exposure=Exposure(opening, None, samples))


def _motion(renderer: Renderer, view: Camera, length: float) -> Callable[[int], Camera]:
    """The view with so many samples of a motion around the scene that takes the splats so far (px)."""
    depth = float(renderer.splats(view).depths.median())
    up = -view.cam_from_world[1, :3]

    def ends(turn: float) -> tuple[Camera, Camera]:
        first, last = (
            replace(orbit(view, side * turn, depth, up), trained_focal=view.trained_focal) for side in (-1, 1)
        )
        return first, last

    def moved(turn: float) -> float:
        first, last = (camera.project(renderer.scene.means)[0] for camera in ends(turn))
        return float((last - first).norm(dim=1).median())

    turn = 1e-3 * length / moved(1e-3)
    return lambda samples: replace(view, exposure=Exposure(None, ends(turn), samples))


def _separate(renderer: Renderer, view: Camera) -> None:
    """Draw the frames of the samples one by one, as sharp views."""
    for camera in exposures.sample_cameras(view):
        renderer(replace(camera, exposure=None))
