"""Levels of detail: lighter scene files for lower sampling rates."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.choices import SpzAxes
from aaplug.core.digests import digest_of_cameras, digest_of_scene, digest_of_values
from aaplug.core.errors import FrameError, OutputError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import check_frame
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.finetuning.refining import refined
from aaplug.io.atomic import claimed, output_folder, refuse_existing
from aaplug.io.cameras import select_views
from aaplug.io.scenes import check_scene_output, write_scene, written_format
from aaplug.io.scenes.manifests import MANIFEST, LevelFile, Manifest, hash_of, is_pyramid, read_manifest, write_manifest
from aaplug.io.scenes.scene_file import FLOAT, SceneFile, matrix_of
from aaplug.levels.chunks import LARGEST, chunks_of
from aaplug.levels.merging import Goal, merged, merged_in_chunks
from aaplug.levels.multi_scale import in_one_scene
from aaplug.levels.pyramids import Level, levels_in
from aaplug.levels.rates import rates_of
from aaplug.methods.filters import fuse_stored
from aaplug.methods.viewers import find_viewer
from aaplug.options.lod import LodOptions
from aaplug.options.objects import AnyPath
from aaplug.rendering.renderer import Renderer
from aaplug.rendering.visibility import VIEWS, visibility
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import CamerasLike, Held, SceneLike, look_of, opened_and_seen, processor, sources_of, whole_of

LEVELS = 4  # as many as usual: down to 1/16 of the training size
MEGABYTE = 1e6
RULE = 2  # of merging and tuning; raised when it changes, so that levels of two rules are not mixed
NORMALS = 3  # columns that a .ply has beside a Gaussian's parameters


@LodOptions.shown
def lod(
    scene: SceneLike | SceneFile,
    cameras: CamerasLike = None,
    output: AnyPath | None = None,
    *,
    drop_bad: bool = False,
    spz_axes: SpzAxes = "auto",
    monitor: Monitor = SILENT,
    **options: Any,
) -> list[Level]:
    """Merge Gaussians: into one lighter scene, or into levels for smaller and smaller images.

    Args:
        scene: Gaussians, a scene's file, opened or not, or a model folder.
        cameras: see `render`; they tell how finely each Gaussian was sampled, and levels are tuned on their views.
        output: the one scene's file; or a folder for NAME_lod0.ply, the scene itself, to NAME_lodN.ply.  None writes
            nothing.
        drop_bad: leave out Gaussians of a file that cannot be used.
        spz_axes: of a .spz to write; see `open_scene`.
        monitor: see `render`.
        options: fields of `LodOptions`.

    Returns:
        The one scene, lighter or with all levels in it; or all levels, first the scene itself.

    Raises:
        AaplugError: as `render`; also, the scene holds 2D Gaussians or none at all.
    """
    o = LodOptions.of(options)
    opened, known = opened_and_seen(scene, cameras, monitor)
    path = None if output is None else Path(output)
    check = partial(_files, path, opened, o)
    files = check()
    whole = fuse_stored(whole_of(opened, drop_bad))
    if whole.pixel_sizes is not None:
        raise UsageError(whole.name, "holds levels already, by the columns of Multi-Scale 3DGS")
    if not len(whole):
        raise UsageError(whole.name, "has no Gaussians to merge")
    if not known.assumed:
        check_frame(whole.means, known.train, whole.name, o.min_seen)
    say_assumed(known, monitor)
    folder = nullcontext() if path is None or o.single else output_folder(path)
    with processor(o.threads), folder, claimed(path, check):
        if o.multi_scale:
            with monitor.progress("merging", "levels") as tell:
                one = in_one_scene(whole, known.train, o.levels or LEVELS, tell)
            if path is not None:
                write_scene(path, one, overwrite=o.overwrite)
            return [Level(one, 0.5 ** (o.levels or LEVELS))]
        make = _maker(whole, known, o, monitor)
        if o.single:
            found = make.finished(make(Level(whole, 1.0), goals_of(o, whole)[0]))
            if path is not None:
                write_scene(path, found.scene, overwrite=o.overwrite, spz_axes=spz_axes)
            return [found]
        return list(_levels(make, path, files, known, o))


@dataclass(frozen=True)
class _Maker:
    """Makes a level of the one before it.

    look: draws the scene as training showed it; None where levels are neither tuned nor merged by what views show.
    views: to tune on, and to merge by; none to merge by where nobody knows the cameras.
    tuned: for aaplug; the next level is made of the result.
    finished: for a viewer.
    """

    scene: Gaussians
    train: Sequence[Camera]
    look: Renderer | None
    views: Sequence[Camera]
    tuned: Callable[[Level], Level]
    finished: Callable[[Level], Level]
    monitor: Monitor

    def __call__(self, before: Level, goal: Goal) -> Level:
        scene, same = before.scene, before._replace(rate=goal.rate)
        if not len(scene):
            return same
        try:
            rates = rates_of(scene, self.train)
        except FrameError:
            if scene is self.scene:
                raise
            return same  # no camera sees any of what is left
        visible = self._visible(before, goal)
        with self.monitor.progress("merging", "Gaussians") as tell:
            if before.chunks is None:
                found, chunks = merged(scene, rates, goal, tell, visible), None
            else:
                found, chunks = merged_in_chunks(scene, rates, before.chunks, goal, tell, visible)
        self.monitor.say(f"{len(found):,} Gaussians for {goal.rate:.3g} × the training rate")
        return self.tuned(Level(found, goal.rate, chunks))

    def _visible(self, before: Level, goal: Goal) -> Float[Tensor, " n"] | None:
        if self.look is None or not self.views:
            return None
        look = self.look if before.scene is self.scene else self.look.showing(before.scene)
        scale = max(goal.rate, before.rate / 2)  # below that, many of its Gaussians are too faint to be drawn
        with self.monitor.progress("looking", "views") as tell:
            return visibility(look, self.views, scale, tell)


def _maker(scene: Gaussians, cameras: CameraSet, o: LodOptions, monitor: Monitor) -> _Maker:
    if cameras.assumed and not o.tuning:
        return _Maker(scene, cameras.train, None, (), _same, _same, monitor)
    look, views = look_of(scene, cameras, o.tuning or VIEWS, o, monitor), select_views(cameras, o.views)
    viewer = find_viewer(o.viewer)

    def tuned(level: Level) -> Level:
        if viewer is not None and level.scene is scene:
            usual = steps_for(scene, viewer)
            steps = o.steps if usual and o.steps is not None else usual
            return level._replace(scene=fit(scene, viewer, look, views, steps, monitor).scene)
        return level._replace(scene=refined(level.scene, level.rate, look, views, o.tuning, viewer, monitor))

    both = (_same, _same) if not o.tuning else (tuned, _same) if viewer is None else (_same, tuned)
    return _Maker(scene, cameras.train, look, () if cameras.assumed else views, *both, monitor)


def goals_of(o: LodOptions, scene: Gaussians) -> list[Goal]:
    """What to merge for, one scene after the other.

    Raises:
        UsageError: the scene has fewer Gaussians than asked for.
    """
    if not o.single:
        return [Goal.of_level(level, o.merge_below) for level in range(1, (o.levels or LEVELS) + 1)]
    if o.budget is not None:
        each = FLOAT * (len(matrix_of(scene[:0])[0]) + NORMALS)
        count = min(len(scene), int(o.budget * MEGABYTE / each))
    else:
        assert o.simplify is not None
        count = round(o.simplify * (len(scene) if o.simplify <= 1 else 1))
    if count > len(scene):
        raise UsageError("simplify", f"asks for {count:,} Gaussians, and the scene has {len(scene):,}")
    goal = Goal.of_count(max(1, count), scene)
    return [goal if o.scale is None else replace(goal, rate=o.scale)]


def _same(level: Level) -> Level:
    return level


def _levels(
    make: _Maker, folder: Path | None, files: Sequence[Path], cameras: CameraSet, o: LodOptions
) -> Iterator[Level]:
    """The scene and its levels, each written before the next is made; levels for a viewer are no pyramid."""
    done: list[Level] = []
    pyramid = folder if o.viewer is None else None
    manifest = Manifest(_source(make.scene, cameras, o) if pyramid else "", LARGEST, ())
    if pyramid and o.resume and is_pyramid(pyramid):
        found = read_manifest(pyramid)
        if found.source != manifest.source:
            raise UsageError("resume", f"{folder} holds levels of another scene, other cameras or other options")
        manifest, done = found, list(levels_in(pyramid, found))
        make.monitor.say(f"resumed: {len(done) - 1} levels are there")
    done = done or [Level(make.scene, 1.0, chunks_of(make.scene.means, LARGEST))]
    goals, finest = goals_of(o, make.scene), done[0].chunks
    assert finest is not None
    count = int(finest.max()) + 1
    for place in range(len(goals) + 1):
        if place >= len(done):
            done.append(make(done[-1], goals[place - 1]))
        shown = make.finished(done[place])
        if folder is not None and place >= len(manifest.levels):
            write_scene(files[place], shown.scene, overwrite=o.overwrite or o.resume)
            if pyramid:
                manifest = replace(manifest, levels=(*manifest.levels, _described(files[place], shown, count)))
                write_manifest(pyramid, manifest)
        yield shown


def _source(scene: Gaussians, cameras: CameraSet, o: LodOptions) -> str:
    """Hash of all that the levels depend on."""
    facts = [digest_of_scene(scene), digest_of_cameras(cameras.train)]
    return digest_of_values(
        (RULE, *facts, cameras.background, o.merge_below, o.tuning, o.views, o.background, o.cull_margin)
    )


def _described(file: Path, level: Level, chunks: int) -> LevelFile:
    assert level.chunks is not None
    counts = torch.bincount(level.chunks, minlength=chunks)
    return LevelFile(file.name, level.rate, hash_of(file), tuple(counts.tolist()))


def _files(output: Path | None, scene: Held | SceneFile, o: LodOptions) -> list[Path]:
    """The files to write, checked before any work."""
    if output is None:
        return []
    sources = sources_of(scene)
    if o.single:
        format = check_scene_output(output, o.overwrite, sources)
        if o.multi_scale and format.name != "ply":
            raise OutputError(output, "cannot hold the columns of Multi-Scale 3DGS; write a .ply")
        return [output]
    if written_format(output):
        raise OutputError(output, "levels go to a folder; for one scene, give `simplify` or `budget`")
    stem = sources[0].stem if sources else "scene"
    files = [output / f"{stem}_lod{level}.ply" for level in range((o.levels or LEVELS) + 1)]
    others = [output / MANIFEST] if o.viewer is None else []
    refuse_existing([*files, *others], o.overwrite or o.resume)
    return files
