"""Images of a scene at new resolutions."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from aaplug.core.cameras import Camera
from aaplug.core.exposures import frame_count
from aaplug.io.cameras import read_camera_path, select_views
from aaplug.io.image_files import image_paths, names_image
from aaplug.options.verbs import RenderOptions
from aaplug.rendering.film import drawn, storage_of
from aaplug.rendering.frames import write_frames
from aaplug.rendering.job import CamerasLike, Job, running, sizes_of
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import counted, one
from aaplug.verbs.verb import AnyPath, SceneLike, writes


class Written(NamedTuple):
    """A rendered view and its file."""

    view: Camera
    file: Path

    def __repr__(self) -> str:
        return f"Written({self.view.name}, {self.view.width}x{self.view.height}, {self.file})"


@writes(RenderOptions)
def render(scene: SceneLike, cameras: CamerasLike, output: AnyPath | None, options: RenderOptions) -> list[Written]:
    """Render views at any resolution to image files.

    Args:
        scene: a scene, its Gaussians, or the path of its file or folder; of a scene in time each view is drawn at every
            frame, and a path shows it once.
        cameras: a camera set, its file or folder; or None for those in the scene's file or model folder,
            or without any for an orbit around the scene; or an `Orbit` of your own.
        output: a folder (None: "images"), or one image file for one view.

    Raises:
        AaplugError: an input cannot be read, an option does not fit, or an image cannot be written.
    """
    target = Path("images" if output is None else output)
    storage, options = storage_of(target, options)
    job = Job.of(scene, cameras, options, single=names_image(target))
    path = None if options.path is None else read_camera_path(options.path)
    ends = select_views(job.cameras, options.camera_to, "camera_to") if options.camera_to else ()
    views = [view for eyes in zip(*drawn(job, path, ends), strict=True) for view in eyes]
    [recipe] = job.fitted(options.recipe)
    check = partial(image_paths, target, views, options.overwrite, storage.format.suffixes[0])
    paths = check()
    with running(options, target, check, job.inputs, folder=not names_image(target)) as workers:
        renderer = job.look(len(views)).by(recipe)
        job.monitor.say(description(renderer, views))
        job.announce([renderer], views, processes=workers.threads)
        job.say_assumed(renderer, views[0])
        with job.monitor.progress("rendering", "views") as tell:
            how = {"storage": storage, "overwrite": options.overwrite, "tell": tell}
            write_frames(renderer, views, paths, workers.pool.map, **how)
    return [Written(*pair) for pair in zip(views, paths, strict=True)]


def description(renderer: Renderer, views: Sequence[Camera]) -> str:
    """Recipe, views, sizes and samples per pixel of the images to render, in words."""
    rates = [renderer.relative_rate(view) for view in views]
    counts, samples = (sorted({*map(count, views)}) for count in (frame_count, renderer.samples))
    grid = " or ".join(f"{n}×{n}" for n in samples)
    exposed = any(view.exposure for view in views)
    mean = f", mean of {' or '.join(map(str, counts))} frame{'s' * (counts != [1])}" * exposed
    span = " to ".join(dict.fromkeys(f"{rate:.3g}" for rate in (min(rates), max(rates))))
    name = renderer.training.convention.name
    kind = one(f"{name} scene{' of 2D Gaussians' * renderer.scene.flat}")
    return (
        f"recipe: {renderer.recipe.name} for {kind}, {counted(len(views), 'view')} at {sizes_of(views)}, "
        f"{span} × the training rate: {grid} sample{'s' * (samples != [1])} per pixel{mean}"
    )
