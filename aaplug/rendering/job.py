"""Job: a scene and its cameras, opened and fitted to each other, and the options of the verb that works on them.

Every verb begins with `Job.of`.  It then checks its output, and draws inside `running`, which limits torch's threads,
claims the output and connects the workers.
"""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Generic, TypeVar

from aaplug.core.cameras import Camera, CameraSet, photographs
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import TakesMemory
from aaplug.core.pyramids import Pyramid
from aaplug.io.atomic import AnyPath, writing
from aaplug.io.cameras import read_cameras, select_views
from aaplug.io.limits import lack_of_memory
from aaplug.io.scenes import SceneLike, scene_of
from aaplug.io.scenes.scene import Scene, without_harmonics
from aaplug.methods import RECIPES
from aaplug.methods.filters.matched import Matched
from aaplug.methods.presets import find_recipe, suited
from aaplug.methods.recipe import Recipe
from aaplug.options.base import Options
from aaplug.options.verbs import ALL, IN_TIME, FrameOptions, Orbit, RecipeOptions, ViewOptions
from aaplug.rasterizers.choice import find_rasterizer
from aaplug.rendering.agreement import agreement, contradictions, settled
from aaplug.rendering.assumed import cameras_around, decibels_at
from aaplug.rendering.cost import Cost, cost_of
from aaplug.rendering.renderer import Renderer, background_colour, own_look
from aaplug.system.errors import FrameError, UsageError, counted, listing, within_memory
from aaplug.system.executors import PAYS_AFTER_SECONDS, Executor, ProcessesIfLong, given_threads, torch_threads
from aaplug.system.extras import check_installed
from aaplug.system.monitor import Monitor

LONG_JOB = 60.0  # seconds of work from which a job is announced
LARGE_JOB = 4e9  # bytes from which it is

log = logging.getLogger("aaplug")
O = TypeVar("O", bound=Options)  # noqa: E741
O_co = TypeVar("O_co", bound=Options, covariant=True)
CamerasLike = CameraSet | Orbit | str | PathLike[str] | None


@dataclass(frozen=True, eq=False)
class Job(Generic[O_co]):
    """A scene by the reading that fits its cameras, these cameras, and a verb's options."""

    scene: Scene
    cameras: CameraSet
    options: O_co

    @classmethod
    def of(cls, scene: SceneLike, cameras: CamerasLike, options: O, single: bool = False) -> "Job[O]":
        """Open the scene and its cameras; raises AaplugError.

        cameras: None for the scene's own, else an `Orbit`.  single: it is asked for one picture.
        """
        opened = scene_of(scene, still=not isinstance(options, IN_TIME))
        if cameras is None:
            cameras = opened.cameras or Orbit()
        if isinstance(cameras, Orbit):
            cameras = cameras_around(opened, cameras, single)
        elif not isinstance(cameras, CameraSet):
            cameras = read_cameras(cameras)
        for what in contradictions(opened, cameras):
            options.monitor.say(f"{opened.camera_path}: {what}")
        return Job(settled(opened, cameras, options.monitor), cameras, options)

    @property
    def monitor(self) -> Monitor:
        """Receiver of messages and progress."""
        return self.options.monitor

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files that no output replaces: those of the scene and of the cameras, and the photographs."""
        return *self.scene.files, *self.cameras.files, *photographs(self.cameras.all)

    @cached_property
    def views(self: "Job[ViewOptions]") -> tuple[Camera, ...]:
        """The views that the options name; of a scene in time, each at every frame, whose number ends its name."""
        views, frames = select_views(self.cameras, self.options.views), self.scene.frames
        moments = enumerate(frames.numbers if frames else ())
        named = tuple(replace(v, frame=k, name=f"{v.name}-{n}", photo=None) for k, n in moments for v in views)
        return named if frames else views

    def look(self: "Job[ViewOptions]", frames: int | None, *, gradients: bool = False, check: bool = True) -> Renderer:
        """The scene as training showed it, with the background and rasterizer that the options ask for.

        frames: number of images that will be rendered in all; None if nobody knows.
        gradients: each of them is a step of an optimization.
        check: say how well scene and cameras fit, which takes seconds.

        Raises FrameError if they seem to be of different captures, and `min_seen` is not 0.
        """
        options, say = self.options, self.monitor.say
        colour = background_colour(options.background, self.cameras)
        if options.background == "auto":
            name = {WHITE: "white", BLACK: "black"}.get(colour, str(colour))
            evidence = "from the camera files" if self.cameras.background else "assumed; --background changes it"
            say(f"background: {name} ({evidence})")
        rasterizer = options.rasterizer
        if isinstance(rasterizer, str):
            rasterizer = find_rasterizer(rasterizer, frames, say, gradients=gradients)
        if options.memory is not None and isinstance(rasterizer, TakesMemory):
            rasterizer = rasterizer.within(options.memory * 1e9)
        look = own_look(self.scene, self.cameras, rasterizer, colour, options.cull_margin, options.min_seen)
        if check:
            self.check_fit(look)
        return look

    def second_look(self: "Job[ViewOptions]", look: Renderer) -> Renderer:
        """The scene as training showed it to these cameras, drawn as an earlier look was; says nothing."""
        margin, least = self.options.cull_margin, self.options.min_seen
        return own_look(self.scene, self.cameras, look.rasterizer, look.background, margin, least)

    def check_fit(self: "Job[FrameOptions]", look: Renderer) -> None:
        """Say how well scene and cameras fit, which takes seconds; raises FrameError as `look`."""
        if not len(look.scene) or self.cameras.assumed:
            return
        fit = agreement(look, self.cameras)
        self.monitor.say(f"fit: {fit}")
        if fit.doubt:
            problem = f"scene and cameras seem to be of different captures or frames: {fit.doubt}"
            if self.options.min_seen > 0:
                hint = "gsplat and nerfstudio train in frames of their own (`aaplug guide formats`)"
                raise FrameError(look.scene.name, f"{problem}; {hint}; if they are right, pass `min_seen` 0")
            log.warning("%s: %s", look.scene.name, problem)

    def named(self: "Job[RecipeOptions]", *recipes: str | Recipe) -> list[Recipe]:
        """Recipes as they are, or by name as the options say; says which of these options none of them takes."""
        options, found = self.options, list[Recipe]()
        for recipe in recipes:
            if isinstance(recipe, str):
                matches = isinstance(RECIPES.find(recipe, "recipe").screen, Matched)
                reference = options.rate_reference if matches else None
                recipe = find_recipe(recipe, quality=options.quality, rate_reference=reference, order=options.order)
            found.append(recipe)
        quality = any(recipe.takes_quality for recipe in found)
        rates = any(isinstance(recipe.screen, Matched) for recipe in found)
        for name, taken in (("quality", quality), ("rate_reference", rates)):
            if not taken and (value := getattr(options, name)) != getattr(RecipeOptions, name):
                names = listing([recipe.name for recipe in found])
                self.monitor.say(f"{name.replace('_', ' ')} {value} is not for recipe {names}")
        return found

    def fitted(self: "Job[RecipeOptions]", *recipes: str | Recipe) -> list[Recipe]:
        """Recipes as `named`, fitted to the scene; raises UsageError if it lacks what one needs."""
        gaussians, _ = without_harmonics(self.scene)
        return [suited(recipe, gaussians) for recipe in self.named(*recipes)]

    def recipes(self: "Job[RecipeOptions]", names: str | Recipe | Sequence[str | Recipe]) -> list[Recipe]:
        """Recipes as `fitted`; of "all", those that the scene has everything for."""
        names = [names] if isinstance(names, str | Recipe) else names
        if ALL not in names:
            return self.fitted(*names)
        (gaussians, _), recipes = without_harmonics(self.scene), self.named(*RECIPES)
        lacks = {recipe.name: recipe.lacks(gaussians) for recipe in recipes}
        for name, lack in lacks.items():
            if lack is not None:
                self.monitor.say(f"recipe {name} left out: {lack}")
        return [suited(recipe, gaussians) for recipe in recipes if lacks[recipe.name] is None]

    def say_assumed(self, renderer: Renderer | None = None, view: Camera | None = None) -> None:
        """Say which training is assumed, if any, and how much a picture hangs on it.

        view: the picture; None for the first test view at the training size.
        """
        if not self.cameras.assumed:
            return
        rate, *lines = self.cameras.notes
        lines.append(rate)
        if renderer is not None:
            decibels = decibels_at(renderer, view or self.cameras.test[0], (0.5, 2.0))
            half, twice = ("the same" if dB == math.inf else f"{dB:.0f} dB from this one" for dB in decibels)
            lines.append(f"with half that rate the image would be {half}, with twice {twice}")
        for line in lines:
            self.monitor.say(line)

    def announce(
        self,
        renderers: Sequence[Renderer],
        views: Sequence[Camera],
        *,
        cost: Cost | None = None,
        work: str | None = None,
        processes: int = 1,
        fewer: str = "views",
    ) -> None:
        """Say how long rendering every view with every renderer will take, and how much memory, where that is much.

        cost: where it is not that of these images.  work: in words, if it is more than these images.
        processes: number that share it.  fewer: what takes less time, in words.

        Raises UsageError if it would take more memory than the limit MEMORY_SHARE of the machine's allows.
        """
        cost = cost or cost_of(renderers, views)
        needed = cost.scene + cost.image * (processes if cost.seconds > PAYS_AFTER_SECONDS else 1)
        what = f"{work or counted(len(views) * len(renderers), 'image')} at {sizes_of(views)}"
        if lacking := lack_of_memory(needed):
            raise UsageError(what, f"would take {lacking}; a smaller `scale` or fewer `threads` need less")
        if cost.seconds >= LONG_JOB or needed >= LARGE_JOB:
            minutes = counted(round(cost.seconds / 60), "minute")
            minutes = f"about {minutes}" if cost.seconds >= LONG_JOB else "under a minute"
            memory = f", {needed / 1e9:.1f} GB" if needed >= LARGE_JOB else ""
            self.monitor.say(f"{what}: {minutes}{memory}; fewer {fewer} take less")


def sizes_of(views: Iterable[Camera]) -> str:
    """The sizes of images, for a message."""
    return listing(sorted({f"{view.width}x{view.height}" for view in views}), most=3)


@dataclass(frozen=True)
class Workers:
    """Those who draw: torch's threads of this process, and the cluster if one is named."""

    threads: int
    cluster: Executor | None

    @property
    def pool(self) -> Executor:
        """The cluster, or processes of this machine where views take long."""
        return self.cluster or ProcessesIfLong(self.threads)


def detached(value: Any) -> Any:
    """An argument of a verb, without what autograd knows of Gaussians and poses."""
    if isinstance(value, Gaussians) and any(column.requires_grad for column in value.columns.values()):
        return replace(value, **{name: column.detach() for name, column in value.columns.items()})
    if isinstance(value, Pyramid):
        return value if (scene := detached(value.scene)) is value.scene else replace(value, scene=scene)
    if isinstance(value, Scene) and value.path is None:
        held = value.levels or value.gaussians()
        return value if (free := detached(held)) is held else Scene.in_memory(free)
    if isinstance(value, Camera) and value.cam_from_world.requires_grad:
        return replace(value, cam_from_world=value.cam_from_world.detach())
    if isinstance(value, CameraSet):
        return replace(value, train=tuple(map(detached, value.train)), test=tuple(map(detached, value.test)))
    if isinstance(value, Mapping):
        return {name: detached(each) for name, each in value.items()}
    return [*map(detached, value)] if isinstance(value, list | tuple) else value


@contextmanager
def running(
    options: Options,
    output: Path | None = None,
    check: Callable[[], object] = lambda: None,
    inputs: Iterable[AnyPath] = (),
    folder: bool = False,
    shared: Path | None = None,
) -> Iterator[Workers]:
    """Limit torch's threads, claim the output and connect the workers that the options name, inside the block.

    check: refuses what must not be written.  inputs: files that no output replaces; both see `io.atomic.writing`.
    folder: the output is one.  shared: folder that all workers see; None for the output's.

    Raises OutputError if the output cannot be written, and UsageError if there are no fit workers.
    """
    threads = getattr(options, "threads", None) or given_threads()
    scheduler = options.scheduler if isinstance(options, RecipeOptions) else None
    with torch_threads(1, threads), writing(output, check, inputs, folder), within_memory("memory"):
        if not isinstance(scheduler, str):
            yield Workers(threads, scheduler)
            return
        check_installed("distributed", "cluster", "scheduler", "needs the extra `cluster`")
        from aaplug.system.cluster import connected  # its package is an extra

        if output is not None:
            shared = output if folder else output.parent
        with connected(scheduler, threads, shared, options.monitor) as cluster:
            yield Workers(threads, cluster)
