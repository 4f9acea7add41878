"""Scenes side by side, each by the rule that it is viewed with, against one truth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.evaluation.metrics import PSNR, SSIM, psnr, ssim
from aaplug.evaluation.results import Measurement, Report
from aaplug.finetuning.truth import Truth
from aaplug.io.images import quantised
from aaplug.methods.recipes import Recipe
from aaplug.rendering.renderer import render, smooth


@dataclass(frozen=True)
class Candidate:
    """A scene and the rule that shows it."""

    name: str
    scene: Gaussians
    recipe: Recipe


def compare(
    candidates: Sequence[Candidate],
    views: Sequence[Camera],
    scales: Sequence[float],
    truth: Truth,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Measure every candidate at every scale; renders and truth are rounded to 8 bits first."""
    found = []
    smoothed = [smooth(c.scene, truth.training, c.recipe) for c in candidates]
    for done, view in enumerate(views):
        progress(done, len(views))
        for scale in scales:
            camera, wanted = view.scaled(scale), quantised(truth(view, scale))
            for candidate, scene in zip(candidates, smoothed, strict=True):
                started = time.perf_counter()
                with torch.no_grad():
                    image = render(
                        scene,
                        camera,
                        candidate.recipe,
                        truth.training,
                        truth.rasterizer,
                        truth.background,
                    ).rgb
                seconds = time.perf_counter() - started
                image = quantised(image)
                values = {PSNR.name: psnr(image, wanted), SSIM["wang"].name: ssim(image, wanted)}
                samples = candidate.recipe.samples_at(truth.training.relative_rate(camera))
                found.append(
                    Measurement(candidate.name, scale, view.name, values, samples, seconds)
                )
    progress(len(views), len(views))
    found.sort(key=lambda m: [c.name for c in candidates].index(m.recipe))
    protocol = {
        "truth": "photographs" if truth.photographs else "self",
        "views": len(views),
        "view_names": [view.name for view in views],
        "scales": list(scales),
        "recipes": {c.name: c.recipe.source for c in candidates},
    }
    return Report(tuple(found), protocol)
