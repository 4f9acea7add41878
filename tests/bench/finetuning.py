"""Seconds per fine-tuning step on the bundled chair, by scale: python -m tests.bench.finetuning [STEPS]."""

import statistics
import sys
import time
from dataclasses import replace
from importlib.resources import as_file, files

from aaplug.core.training import TrainingViews
from aaplug.evaluation.truth import MEMORY, Truth
from aaplug.finetuning.loop import advance
from aaplug.finetuning.settings import CONSISTENCY_SETTINGS
from aaplug.finetuning.state import TuningJob, begin
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.rendering.renderer import own_look


def main(steps: int = 9) -> None:
    """Time a number of steps at every scale."""
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply").gaussians(), read_cameras(sample)
    look = own_look(scene, TrainingViews.of(scene, cameras), background="white")
    print(f"rasterizer: {look.rasterizer.name}")
    views = cameras.train[:1]  # its truth is made in the first step, which is not counted
    for scale in (1.0, 0.5, 0.25, 0.125):
        settings = replace(CONSISTENCY_SETTINGS, weights={scale: 1.0}, anchor=0.0, steps=steps)
        job = TuningJob(look, views, Truth(look, memory=MEMORY), settings)
        state, seconds = begin(job), []
        for _ in range(steps):
            started = time.perf_counter()
            advance(job, state)
            seconds.append(time.perf_counter() - started)
        width = views[0].scaled(scale).width
        print(f"{width} px: {statistics.median(seconds[1:]):.3f} s per step, of {steps - 1}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
