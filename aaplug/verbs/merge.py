"""Merging: several scenes in one file, each where it is wanted, by one rule of drawing."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from aaplug.core.conventions import CONVENTIONS, MIP
from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.placing import placed
from aaplug.io.limits import lack_of_memory
from aaplug.io.scenes import check_scene_output, scene_of, write_scene
from aaplug.io.scenes.columns import check_values
from aaplug.io.scenes.packed import of_degree
from aaplug.io.scenes.ply import beside
from aaplug.io.scenes.scene import memory_of
from aaplug.methods.conversion import carried
from aaplug.options.verbs import MergeOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import own_look
from aaplug.system.errors import UsageError, counted
from aaplug.verbs.verb import AnyPath, ScenesLike, compares

TURNS = (3, 4)  # numbers of a turn: degrees about x, y and z, or a quaternion


@compares(MergeOptions)
def merge(scenes: ScenesLike, cameras: CamerasLike, output: AnyPath | None, options: MergeOptions) -> Gaussians:
    """Join scenes of any formats, conventions and degrees into one, and write it.

    A scene is converted where its convention is not the merged one, by its training cameras; its stored 3D filter is
    fused.  It is then scaled and turned about its origin and moved, its harmonics with it.  The merged scene has the
    highest degree, and the records of all fusions.

    Args:
        scenes: scenes, their Gaussians or their paths.
        cameras: those that every scene was trained with, in the scene's own frame; see `render`.  None for those of
            each model folder, else an `Orbit`.
        output: file to write, of a format that can be written; None writes none.

    Raises:
        AaplugError: as `render`; also, some scenes hold 2D Gaussians and others do not, there are not as many moves,
            turns or scales as scenes, or all scenes together take more than the limit MEMORY_SHARE.
    """
    opened = [scene_of(scene, still=True) for scene in (scenes.values() if isinstance(scenes, Mapping) else scenes)]
    if not opened:
        raise UsageError("scenes", "needs at least one, got none")
    if len({scene.flat for scene in opened}) > 1:
        raise UsageError("scenes", "some hold 2D Gaussians and others do not; one file cannot hold both")
    places = list(zip(*_places(options, len(opened)), strict=True))
    count, degree = sum(scene.count for scene in opened), max(scene.sh_degree for scene in opened)
    if lacking := lack_of_memory(memory_of(count, degree)):
        raise UsageError("scenes", f"their {count:,} Gaussians take {lacking}; AAPLUG_MEMORY_SHARE=1 allows all")
    own = {scene.convention for scene in opened}
    into = CONVENTIONS[options.into] if options.into else own.pop() if len(own) == 1 else MIP
    jobs = [None if scene.convention == into else Job.of(scene, cameras, options) for scene in opened]
    path = None if output is None else Path(output)
    inputs = [file for scene, job in zip(opened, jobs, strict=True) for file in (job.inputs if job else scene.files)]
    check = partial(check_scene_output, path, options.overwrite, inputs) if path else lambda: None
    check()
    with running(options, path, check, inputs):
        parts = list[Gaussians]()
        for scene, job, (turn, scale, move) in zip(opened, jobs, places, strict=True):
            part = fuse_stored((job.scene if job else scene).gaussians())
            if job:
                look = own_look(part, job.cameras, min_seen=options.min_seen)
                job.check_fit(look)
                known = f"by {counted(len(job.cameras.train), 'camera')}"
                views = job.cameras.notes[0] if job.cameras.assumed else known
                job.monitor.say(f"{scene.title}: converted from {part.convention.name} to {into.name}, {views}")
                part = carried(part, look.training, into)
            if lost := beside(part):
                options.monitor.say(f"{scene.title}: the merged scene does not have its {lost}")
            parts.append(replace(placed(part, turn, scale, move), extras={}, origin=None))
        fused = {str(f): f for part in parts for f in part.fused}
        merged = joined([replace(of_degree(part, degree), fused=tuple(fused.values())) for part in parts])
        check_values(merged)
        if path is not None:
            write_scene(path, merged, overwrite=options.overwrite, spz_axes=options.spz_axes)
    return merged


def _places(
    options: MergeOptions, count: int
) -> tuple[list[Float[Tensor, "3 3"]], Sequence[float], list[Sequence[float]]]:
    """Turn, scale and move of each scene."""

    def rows(name: str, values: Sequence[float] | None, widths: Sequence[int]) -> list[Sequence[float]]:
        if values is None:
            return [[0.0] * widths[0]] * count
        width, rest = divmod(len(values), count)
        if rest or width not in widths:
            wanted = " or ".join(f"{count * each}" for each in widths)
            raise UsageError(name, f"expected {wanted} numbers for {counted(count, 'scene')}, got {len(values)}")
        return [values[i * width : (i + 1) * width] for i in range(count)]

    turns = list[Float[Tensor, "3 3"]]()
    for turn in rows("turn", options.turn, TURNS):
        if len(turn) == len("wxyz") and not any(turn):
            raise UsageError("turn", "expected a quaternion, got one of length 0")
        if len(turn) == len("xyz"):
            rotation = Rotation.from_euler("xyz", turn, degrees=True)
        else:
            rotation = Rotation.from_quat([*turn[1:], turn[0]])
        turns.append(torch.from_numpy(rotation.as_matrix()))
    scales = [1.0] * count if options.scale is None else [each for (each,) in rows("scale", options.scale, (1,))]
    return turns, scales, rows("move", options.move, TURNS[:1])
