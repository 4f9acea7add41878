"""Levels of detail: lighter scene files for lower sampling rates."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

from aaplug.core.cameras import Camera
from aaplug.core.errors import OutputError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import check_frame
from aaplug.io.atomic import output_folder, refuse_existing
from aaplug.io.scenes import SpzAxes, check_scene_output, write_scene, written_format
from aaplug.io.scenes.scene_file import FLOAT, SceneFile, matrix_of
from aaplug.levels.merging import Goal, merged
from aaplug.levels.rates import rates_of
from aaplug.verbs.inputs import (
    AnyPath,
    CamerasLike,
    SceneLike,
    cameras_of,
    opened_with,
    processor,
    sources_of,
    whole_of,
)
from aaplug.verbs.options import THREADS, UNSET, FrameOptions, number

LEVELS = 4  # as many as usual: down to 1/16 of the training size
MEGABYTE = 1e6
NORMALS = 3  # columns that a .ply has beside a Gaussian's parameters


@dataclass(frozen=True)
class Level:
    """A lighter scene.

    rate: sampling rate relative to training's that it is meant for.
    """

    scene: Gaussians
    rate: float


@dataclass(frozen=True, kw_only=True)
class LodOptions(FrameOptions):
    """How light."""

    simplify: Annotated[float | None, number(1e-6, 1e9), UNSET] = None
    """Write one scene with this share of the Gaussians; above 1, with so many."""
    budget: Annotated[float | None, number(0.001, 1e6), UNSET] = None
    """Write one scene of as many Gaussians as fit into a .ply of so many MB (10^6 bytes)."""
    levels: Annotated[int | None, number(1, 12, whole=True), UNSET] = None
    """Write a folder of levels, each for half the size of the one before, as light as the image allows (default: 4)."""
    threads: Annotated[int | None, THREADS, UNSET] = None
    """Processor threads (default: all)."""
    overwrite: bool = False
    """Replace existing outputs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in ("simplify", "budget", "levels") if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(given[1], f"cannot be combined with `{given[0]}`: each asks for other files")

    @property
    def single(self) -> bool:
        """Whether one scene is asked for, not levels."""
        return self.simplify is not None or self.budget is not None

    def goals(self, scene: Gaussians) -> list[Goal]:
        """What to merge for, one scene after the other.

        Raises:
            UsageError: the scene has fewer Gaussians than asked for.
        """
        if not self.single:
            return [Goal.of_level(level) for level in range(1, (self.levels or LEVELS) + 1)]
        if self.budget is not None:
            each = FLOAT * (len(matrix_of(scene[:0])[0]) + NORMALS)
            count = min(len(scene), int(self.budget * MEGABYTE / each))
        else:
            assert self.simplify is not None
            count = round(self.simplify * (len(scene) if self.simplify <= 1 else 1))
        if count > len(scene):
            raise UsageError("simplify", f"asks for {count:,} Gaussians, and the scene has {len(scene):,}")
        return [Goal.of_count(max(1, count), scene)]


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
        cameras: training cameras, their file or folder, which tell how finely each Gaussian was sampled.  None: the
            median Gaussian is taken to be a pixel wide.
        output: the one scene's file; or a folder for NAME_lod0.ply, the scene itself, to NAME_lodN.ply.  None writes
            nothing.
        drop_bad: leave out Gaussians of a file that cannot be used.
        spz_axes: of a .spz to write; see `open_scene`.
        monitor: see `render`.
        options: fields of `LodOptions`.

    Returns:
        The one lighter scene; or all levels, first the scene itself.

    Raises:
        AaplugError: as `render`; also, the scene holds 2D Gaussians or none at all.
    """
    o = LodOptions.of(options)
    known = None if cameras is None else cameras_of(cameras, scene)
    train = () if known is None else known.train
    opened = opened_with(scene, known, monitor)
    files = _files(None if output is None else Path(output), opened, o)
    whole = whole_of(opened, drop_bad)
    if not len(whole):
        raise UsageError(whole.name, "has no Gaussians to merge")
    if train:
        check_frame(whole.means, train, whole.name, o.min_seen)
    folder = output_folder(files[0].parent) if files and not o.single else nullcontext()
    found = []
    with processor(o.threads), folder:
        for level, file in zip_longest(_levels(whole, train, o, monitor), files):
            if file is not None:
                write_scene(file, level.scene, overwrite=o.overwrite, spz_axes=spz_axes)
            found.append(level)
    return found


def _files(output: Path | None, scene: Gaussians | SceneFile, o: LodOptions) -> list[Path]:
    """The files to write, checked before any work."""
    if output is None:
        return []
    sources = sources_of(scene)
    if o.single:
        check_scene_output(output, o.overwrite, sources)
        return [output]
    if written_format(output):
        raise OutputError(output, "levels go to a folder; for one scene, give `simplify` or `budget`")
    stem = sources[0].stem if sources else "scene"
    files = [output / f"{stem}_lod{level}.ply" for level in range((o.levels or LEVELS) + 1)]
    refuse_existing(files, o.overwrite)
    return files


def _levels(scene: Gaussians, train: Sequence[Camera], o: LodOptions, monitor: Monitor) -> Iterator[Level]:
    """The scenes that were asked for, each made of the one before."""
    if not o.single:
        yield Level(scene, 1.0)
    for goal in o.goals(scene):
        with monitor.progress("merging", "Gaussians") as tell:
            scene = merged(scene, rates_of(scene, train), goal, tell)
        monitor.say(f"{len(scene):,} Gaussians for {goal.rate:.3g} × the training rate")
        yield Level(scene, goal.rate)
