"""Levels of detail: lighter scene files for lower sampling rates."""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count, takewhile
from pathlib import Path

import torch

from aaplug.core.camera_paths import up_of
from aaplug.core.cameras import digest_of_cameras
from aaplug.core.chunks import MAX_CHUNK_GAUSSIANS, chunks_of
from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import digest_of_scene
from aaplug.core.orbits import frame_of
from aaplug.core.pyramids import Level
from aaplug.core.sampling import check_frame, median_rates
from aaplug.finetuning.level_maker import DEFAULT_LEVELS, LevelMaker
from aaplug.finetuning.refining import refine_tree
from aaplug.io import StreamName, streamed
from aaplug.io.atomic import AnyPath, refuse_existing, refuse_inputs
from aaplug.io.scenes import SceneLike, check_scene_output, pyramid_folder, write_scene, written_format
from aaplug.io.scenes.ply import beside
from aaplug.io.scenes.pyramid_folder import MANIFEST
from aaplug.io.scenes.scene import Scene
from aaplug.io.streamed import STREAMS
from aaplug.methods.viewers import MIP_VIEWER
from aaplug.options.verbs import LodOptions
from aaplug.rendering.assumed import PROBE_ROWS
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.system.digests import digest_of_files, digest_of_values
from aaplug.system.errors import IS_COMPLETE, FormatError, OutputError, UsageError, counted
from aaplug.verbs.verb import writes

MERGING_RULE = 4  # raised when merging or tuning changes, so that levels of two rules are not mixed


@writes(LodOptions)
def lod(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: LodOptions) -> list[Level]:
    """Merge Gaussians: into one lighter scene, or into levels for smaller and smaller images.

    Args:
        scene: see `render`.
        cameras: see `render`; they tell how finely each Gaussian was sampled, and levels are tuned on their views.
        output: the one scene's file; or a folder for NAME_lod0.ply, the scene itself, to NAME_lodN.ply, or for what
            `to` names.  None writes nothing.

    Returns:
        The one scene; or all levels, first the scene itself.  With `to` and an output, their harmonics are NaN and
        take no memory: they are in the files.  For "rad" they are as merged, and the file's tree is tuned.

    Raises:
        AaplugError: as `render`; also, the scene holds no Gaussians, or 2D ones and `viewer` or `to` is given.
    """
    job = Job.of(scene, cameras, options)
    path = None if output is None else Path(output)
    check = partial(_outputs, path, job.scene, options)
    files, stale = check()
    whole = fuse_stored(job.scene.gaussians())
    if not len(whole):
        raise UsageError(whole.name, "has no Gaussians to merge")
    if path is not None and options.to is not None:
        streamed.check_positions(path, options.to, whole)
    if not job.cameras.assumed:
        check_frame(whole.means, job.cameras.train, whole.name, options.min_seen)
    job.say_assumed()
    if lost := beside(whole):
        job.monitor.say(f"{whole.name}: merged Gaussians do not have its {lost}")
    with running(options, path, check, job.inputs, folder=not options.single):
        maker = LevelMaker.of(whole, job)
        if options.single:
            lighter = maker.finished(maker(Level(whole, 1.0), maker.goals[0]))
            if path is not None:
                how = (maker.viewer or MIP_VIEWER).spz(options.spz_axes)
                write_scene(path, lighter.scene, overwrite=options.overwrite, **how)
            return [lighter]
        if path is None or options.to is None:
            levels = list(_levels(maker, path, files))
        else:
            levels = _streamed(maker, path, options.to, files)
        for file in stale:
            file.unlink(missing_ok=True)
        return levels


def _levels(maker: LevelMaker, folder: Path | None, files: Sequence[Path]) -> Iterator[Level]:
    """The scene and its levels, each written before the next is made; levels for a viewer are no pyramid.

    Streamed levels are cut before the pyramid, which they are made of, lists them; it is removed at the end.
    """
    options = maker.job.options
    there: Iterator[Level] = iter(())
    pyramid = folder if options.viewer is None or options.to else None
    goals = maker.goals
    cameras = maker.job.cameras
    facts = [digest_of_scene(maker.scene), digest_of_cameras(cameras.train), cameras.background] if pyramid else []
    choices = [options.merge_below, options.tuning, options.views, options.background, options.cull_margin]
    stream = [] if options.to is None else [options.to, maker.viewer and maker.viewer.name]
    source = digest_of_values((MERGING_RULE, *facts, *choices, *stream))  # of all that the levels depend on
    manifest = pyramid_folder.Manifest(source, MAX_CHUNK_GAUSSIANS, len(goals) + 1, ())
    if pyramid and options.resume and pyramid_folder.is_pyramid(pyramid):
        earlier = pyramid_folder.read_manifest(pyramid, unfinished=True)
        if earlier.source != manifest.source:
            raise UsageError("resume", f"{folder} holds levels of another scene, other cameras or other options")
        there = pyramid_folder.levels_in(pyramid, earlier, start=1)  # the first is the scene itself
        manifest = replace(manifest, count=max(len(goals) + 1, len(earlier.levels)), levels=earlier.levels)
        maker.job.monitor.say(f"resumed with {counted(len(earlier.levels) - 1, 'level')}")
    made = Level(maker.scene, 1.0, chunks_of(maker.scene.means, MAX_CHUNK_GAUSSIANS))
    leaves, front = streamed.leaves_of(made), None
    for place in range(len(goals) + 1):
        if place:
            made = next(there, None) or maker(made, goals[place - 1])
        resumed, level = place < len(manifest.levels), made
        if options.to == "rad":
            start = len(front.scene) if front else 0
            front = streamed.read_front(folder, place) if resumed and folder else maker.above(front, made)
            level = Level(front.scene[front.parents < 0], made.rate)
            if folder is not None and not resumed:
                streamed.write_front(folder, place, front, start)
        elif options.to is None or not resumed:
            level = maker.finished(made)
            if options.to is not None and folder is not None:
                parts = streamed.parts_of(level, leaves, streamed.middle_of(maker.scene, options.to))
                streamed.write_level(folder, options.to, place, parts)
        if folder is not None and not resumed:
            kept = made if options.to else level
            write_scene(files[place], kept.scene, overwrite=options.overwrite or options.resume)
            if pyramid:
                assert made.chunks is not None
                counts = torch.bincount(made.chunks, minlength=len(leaves)).tolist()
                digest = digest_of_files([files[place]])
                entry = pyramid_folder.LevelFile(files[place].name, level.rate, digest, tuple(counts))
                manifest = replace(manifest, levels=(*manifest.levels, entry))
                pyramid_folder.write_manifest(pyramid, manifest)
        yield level


def _streamed(maker: LevelMaker, folder: Path, to: StreamName, files: Sequence[Path]) -> list[Level]:
    """The levels, streamed; what a run that is cut short resumes from is removed."""
    options, cameras, earlier = maker.job.options, maker.job.cameras, streamed.part_folders(folder, to)
    (folder / STREAMS[to].index).unlink(missing_ok=True)
    levels = []
    for level in _levels(maker, folder, files):
        sh = level.scene.sh
        scene = replace(level.scene, sh=sh.new_full((1, 1, 1), torch.nan).expand(sh.shape))
        levels.append(level._replace(scene=scene))
    rates = median_rates(maker.scene.means, cameras.train)
    compensated = maker.viewer is None or maker.viewer.convention_of(maker.scene).compensated
    up = up_of(cameras).tolist()
    frame = frame_of(maker.job.scene.sample(PROBE_ROWS), up if any(up) else None)
    rate = float(rates[rates > 0].median())
    tree = None
    if to == "rad":
        tree = streamed.read_front(folder, len(levels) - 1)
        if options.tuning and maker.look is not None and maker.viewer is not None:
            rates_of_levels = [level.rate for level in levels]
            how = (rates_of_levels, maker.look, maker.views, options.tuning, maker.viewer, maker.job.monitor)
            tree = tree._replace(scene=refine_tree(tree.scene, tree.parents, *how))
    if options.page is not None:  # before the index, which says that all is there
        streamed.write_page(folder, to, Path(options.page))
    middle = streamed.middle_of(maker.scene, to)
    settings = streamed.write_index(folder, to, len(levels), rate, frame, compensated, tree, middle)
    maker.job.monitor.say(f"set the viewer by {folder / streamed.SETTINGS}: {json.dumps(settings)}")
    streamed.remove_parts(earlier - streamed.part_folders(folder, to), to)
    if to == "rad":
        streamed.remove_parts(streamed.front_folders(folder), to)
    for file in [*files, folder / MANIFEST, *(streamed.facts_file(folder, place) for place in range(len(levels)))]:
        file.unlink(missing_ok=True)
    return levels


def is_made(output: Path, options: LodOptions) -> bool:
    """True if the output is complete: the one scene, or at least as many levels as the options ask for."""
    if options.single:
        return output.is_file()
    with suppress(FormatError):  # making them tells what is damaged
        if options.to is not None:
            made = streamed.level_count(output, options.to)
        else:
            made = len(pyramid_folder.read_manifest(output, unfinished=True).levels)
        return made > (options.levels or DEFAULT_LEVELS)
    return False


def _outputs(output: Path | None, scene: Scene, options: LodOptions) -> tuple[list[Path], list[Path]]:
    """The files to write and an earlier run's to remove, checked before any work."""
    if output is None:
        return [], []
    if options.single:
        check_scene_output(output, options.overwrite, scene.files)
        return [output], []
    if written_format(output) or output.suffix == Path(STREAMS["rad"].index).suffix:
        raise OutputError(output, "levels go to a folder; for one scene, give `simplify` or `budget`")
    stem = scene.source.stem if scene.source else "scene"
    files = [output / f"{stem}_lod{level}.ply" for level in range((options.levels or DEFAULT_LEVELS) + 1)]
    others = [output / MANIFEST] if options.viewer is None or options.to else []
    if options.to is not None:
        if options.resume and not options.overwrite and is_made(output, options):
            raise OutputError(output, IS_COMPLETE)
        refuse_existing([output / STREAMS[options.to].index], options.overwrite)
        for name, stream in STREAMS.items():
            if name != options.to and (output / stream.index).exists():
                raise OutputError(output, f"holds levels for another viewer ({stream.index}); name another folder")
        if options.page is not None:
            streamed.programs_of(options.to, Path(options.page))
    refuse_existing([*files, *others], options.overwrite, options.resume)
    if not options.overwrite:
        return files, []
    stale = list(takewhile(Path.is_file, (output / f"{stem}_lod{level}.ply" for level in count(len(files)))))
    if pyramid_folder.is_pyramid(output):
        with suppress(FormatError):
            stale += [output / level.file for level in pyramid_folder.read_manifest(output, unfinished=True).levels]
        stale.append(output / MANIFEST)
    stale += takewhile(Path.is_file, (streamed.facts_file(output, level) for level in count(len(files))))
    stale = [file for file in stale if file not in (*files, *others)]
    refuse_inputs(stale, scene.files)
    return files, stale
