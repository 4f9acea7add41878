"""Seconds a fine-tuning step on the bundled chair, by scale: python -m tests.bench.finetuning [STEPS]."""

import statistics
import sys
import time
from dataclasses import replace
from importlib.resources import as_file, files

from aaplug.core.cameras import WHITE
from aaplug.finetuning import OURS, Job, Truth, advance, begin
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.methods.recipes import RECIPES
from aaplug.rasterizers.tiled.ahead_of_time import choose
from aaplug.rendering.renderer import learn


def main(steps: int = 9) -> None:
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply"), read_cameras(sample)
    training = learn(scene, cameras.train)
    rasterizer = choose("auto", 1, print)
    truth = Truth(scene, training, rasterizer, WHITE)
    for scale in (1.0, 0.5, 0.25, 0.125):
        settings = replace(OURS, weights={scale: 1.0}, anchor=0.0, steps=steps)
        views = cameras.train[:1]  # its truth is made in the first step, which is not counted
        job = Job(scene, training, RECIPES["matched"], views, truth, settings, rasterizer, WHITE)
        state, seconds = begin(job), []
        for _ in range(steps):
            started = time.perf_counter()
            advance(job, state)
            seconds.append(time.perf_counter() - started)
        width = views[0].scaled(scale).width
        print(f"{width} px: {statistics.median(seconds[1:]):.3f} s a step, of {steps - 1}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
