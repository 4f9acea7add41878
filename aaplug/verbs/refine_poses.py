"""Poses of cameras, refined on their photographs."""

from aaplug.core.cameras import CameraSet
from aaplug.finetuning.poses import RefinedPose, refined
from aaplug.options.verbs import PoseOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.system.errors import UsageError
from aaplug.verbs.verb import SceneLike, looks


@looks(PoseOptions)
def refine_poses(
    scene: SceneLike | None, cameras: CamerasLike, options: PoseOptions
) -> tuple[CameraSet, tuple[RefinedPose, ...]]:
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
        return refined(job.look(len(job.views), gradients=True), job.cameras, job.views, job.monitor)
