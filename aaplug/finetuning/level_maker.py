"""The maker of levels of detail: each is merged from the one before it, and tuned."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.pyramids import Level
from aaplug.core.training import TrainingViews
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.finetuning.refining import refine
from aaplug.io.rad import MAX_NODE_SIZE, node_sizes
from aaplug.io.scenes.columns import columns_of
from aaplug.io.scenes.scene import FLOAT
from aaplug.io.streamed import STREAMS, Front
from aaplug.levels.clusters import rates_of
from aaplug.levels.merging import TOLERANCE, Goal, merge
from aaplug.methods.conversion import fuse_for
from aaplug.methods.viewers import Viewer, find_viewer
from aaplug.options.verbs import LodOptions
from aaplug.rendering.job import Job
from aaplug.rendering.renderer import Renderer, own_look
from aaplug.rendering.visibility import MAX_VIEWS, visibility
from aaplug.system.errors import FrameError, UsageError, counted

DEFAULT_LEVELS = 4  # down to 1/16 of the training size
MEGABYTE = 1e6
# At most, of the header of a .ply: the records of merging and tuning, and what it says of a column.
RECORDS_BYTES, COLUMN_BYTES = 1500, 24
SMALLER_IMAGES = (0.5,)  # of one lighter scene, which has no coarser level; a viewer's rule would bloat it there
NORMAL_COLUMNS = 3  # that a .ply has beside a Gaussian's parameters


@dataclass(frozen=True, eq=False)
class LevelMaker:
    """Makes a level of the one before it.

    look: draws the scene as training showed it; None where levels are neither tuned nor merged by visibility.
    views: to tune on, and to merge by; none to merge by where nobody knows the cameras.
    viewer: whose rule each file is tuned for; levels for aaplug are made of tuned ones.
    """

    scene: Gaussians
    job: Job[LodOptions]
    look: Renderer | None
    views: Sequence[Camera]
    viewer: Viewer | None

    @classmethod
    def of(cls, scene: Gaussians, job: Job[LodOptions]) -> "LevelMaker":
        """The maker that the options ask for."""
        viewer = find_viewer(job.options.viewer or (job.options.to and STREAMS[job.options.to].viewer))
        if scene.flat and viewer is not None:
            raise UsageError(scene.name, "holds 2D Gaussians, whose levels only aaplug draws; leave out `viewer`, `to`")
        if scene.flat and job.options.tuning:
            job.monitor.say("2D Gaussians are merged alone: they have no fast gradients to tune by")
        if job.cameras.assumed and (scene.flat or not job.options.tuning):
            return cls(scene, job, None, (), viewer)
        look = job.look(job.options.tuning or MAX_VIEWS)
        if scene.flat:  # what views show of discs is found by 3D Gaussians without thickness, whose gradients are fast
            look = own_look(replace(scene, flat=False), look.training, look.rasterizer, look.background)
        return cls(scene, job, look, job.views, viewer)

    @property
    def goals(self) -> list[Goal]:
        """The goals of merging, one after the other.

        Raises UsageError if the scene, which is not empty, has fewer Gaussians than asked for.
        """
        options, scene = self.job.options, self.scene
        if not options.single:
            levels = range(1, (options.levels or DEFAULT_LEVELS) + 1)
            return [Goal(0.5**level, tolerance=TOLERANCE, smallest=options.merge_below) for level in levels]
        if options.budget is not None:
            columns = len(columns_of(scene[:0])) + NORMAL_COLUMNS
            header = RECORDS_BYTES + COLUMN_BYTES * columns
            count = min(len(scene), int((options.budget * MEGABYTE - header) / (FLOAT * columns)))
            if count < 1:
                raise UsageError("budget", f"holds no Gaussian beside the header of a .ply, of up to {header:,} bytes")
        else:
            assert options.simplify is not None
            count = round(options.simplify * (len(scene) if options.simplify <= 1 else 1))
        if count > len(scene):
            raise UsageError("simplify", f"asks for {counted(count, 'Gaussian')}, and the scene has {len(scene):,}")
        count = max(1, count)
        rate = min(1.0, math.sqrt(count / len(scene)))  # a quarter is meant for half the size, as on a surface
        return [Goal(options.scale or rate, count)]

    def __call__(self, before: Level, goal: Goal) -> Level:
        """The level for a goal."""
        scene, monitor = before.scene, self.job.monitor
        unchanged = before._replace(rate=goal.rate, parents=torch.arange(len(scene)))
        if not len(scene):
            return unchanged
        try:
            rates = rates_of(scene, self.job.cameras.train)
        except FrameError:
            if scene is self.scene:
                raise
            return unchanged  # no camera sees any of what is left
        visible = None
        if self.look is not None and not self.job.cameras.assumed:
            look = self.look if scene is self.scene else self.look.showing(replace(scene, flat=False))
            scale = max(goal.rate, before.rate / 2)  # below that, many of its Gaussians are too faint to be drawn
            with monitor.progress("looking", "views") as tell:
                visible = visibility(look, self.views, scale, tell)
        with monitor.progress("merging", "Gaussians") as tell:
            level = merge(scene, rates, goal, tell, visible, before.chunks)
        monitor.say(f"{counted(len(level.scene), 'Gaussian')} for {goal.rate:.3g} × the training rate")
        return self._tuned(level) if self.viewer is None else level

    def finished(self, level: Level) -> Level:
        """The level as its file holds it: tuned or, without tuning, converted for the viewer, if there is one.

        Levels of a tree are tuned later, all together.
        """
        if self.viewer is None or not len(level.scene):
            return level
        if self.job.options.tuning and self.job.options.to != "rad":
            return self._tuned(level)
        training = TrainingViews.of(level.scene, self.job.cameras, min_seen=0.0)
        return level._replace(scene=fuse_for(level.scene, training, self.viewer))

    def above(self, front: Front | None, level: Level) -> Front:
        """The front with a level above it: of its Gaussians, those that Spark draws at the level's rate.

        A larger one would be replaced by its children, so they stay on the front.
        """
        if front is None or level.parents is None:
            return Front.of(self.finished(level).scene)
        if not len(level.scene):
            return front
        owners, places = level.parents[front.owners], (front.parents < 0).nonzero()[:, 0]
        try:
            px = level.rate * rates_of(level.scene, self.job.cameras.train)
        except FrameError:  # no camera sees any of what is left
            return front._replace(owners=owners)
        small = node_sizes(level.scene) * px <= MAX_NODE_SIZE
        taken, goes = small.nonzero()[:, 0], small[owners]
        if not len(taken):
            return front._replace(owners=owners)
        new = self.finished(level._replace(scene=level.scene[taken])).scene
        parents = len(front.scene) + (small.cumsum(0) - 1)[owners[goes]]
        return Front(
            joined([front.scene, new]),
            torch.cat([front.parents.index_copy(0, places[goes], parents), torch.full((len(new),), -1)]),
            torch.cat([owners[~goes], taken]),
        )

    def _tuned(self, level: Level) -> Level:
        options, look = self.job.options, self.look
        if not options.tuning or look is None or self.scene.flat:
            return level
        if self.viewer is not None and level.scene is self.scene:
            usual = steps_for(self.scene, self.viewer)
            steps = options.steps if usual and options.steps is not None else usual
            return level._replace(scene=fit(self.scene, self.viewer, look, self.views, steps, self.job.monitor)[0])
        smaller = SMALLER_IMAGES if options.single and self.viewer is None else ()
        how = (self.views, options.tuning, self.viewer, self.job.monitor, smaller)
        scene = refine(level.scene, level.rate, look, *how)
        return level._replace(scene=scene)
