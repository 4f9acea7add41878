"""Poses of cameras, refined on their photographs."""

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from aaplug.core.cameras import Camera, CameraSet
from aaplug.finetuning.poses import RefinedPose, refine_pose
from aaplug.io.scenes import SceneLike
from aaplug.methods.presets import find_recipe
from aaplug.options.shared import ViewOptions
from aaplug.options.verbs import PoseOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, counted
from aaplug.verbs.verb import looks

Refined = tuple[CameraSet, tuple[RefinedPose, ...]]


@looks(PoseOptions)
def refine_poses(scene: SceneLike | None, cameras: CamerasLike, options: PoseOptions) -> Refined:
    """Move cameras until the scene looks like their photographs, coarse to fine.

    Intrinsics stay.  A view stays where it is if it gains less than the scene's own errors could give it.

    Args:
        scene: see `render`.
        cameras: see `render`; each view has a photograph.

    Returns:
        The cameras with the poses of `views` refined, and how each of these views was moved.

    Raises:
        AaplugError: as `render`; also, a view has no photograph.
    """
    if scene is None:
        raise UsageError("scene", "name one")
    job = Job.of(scene, cameras, options)
    with running(options):
        return refined(job, job.look(len(job.views), gradients=True), job.views)


def refined(job: Job[ViewOptions], look: Renderer, views: Sequence[Camera]) -> Refined:
    """A job's cameras, with the poses of some views refined, and a note that says by how much.

    Raises UsageError if a view has no photograph.
    """
    if bare := [view.name for view in views if view.photo is None]:
        raise UsageError(bare[0], "has no photograph, on which its pose is refined")
    renderer, poses = look.by(find_recipe("auto", quality="fast")), []
    with job.monitor.progress("refining poses", "views") as tell:
        for done, view in enumerate(views):
            tell(done, len(views))
            poses.append(refine_pose(renderer, view))
    moved = {id(view): pose.camera for view, pose in zip(views, poses, strict=True)}
    splits = {s: tuple(moved.get(id(v), v) for v in vars(job.cameras)[s]) for s in ("train", "test")}
    changed = [(p.degrees, p.distance, p.before, p.after) for p in poses if p.after < p.before]
    count = counted(len(poses), "pose")
    note = f"{count}: none moved, as photographs show nothing better"
    if changed:
        turn, shift, before, after = map(median, zip(*changed, strict=True))
        moves = f"{len(changed)} of {count} moved, in the median by {turn:.2g}° and {shift:.2g} units"
        note = f"{moves}: error at the training size from {before:.1f} to {after:.1f} of 255 levels"
    job.monitor.say(note)
    return replace(job.cameras, **splits, notes=(*job.cameras.notes, note)), tuple(poses)
