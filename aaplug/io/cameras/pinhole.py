"""Plain pinholes in JSON: one object, or a list of them.

{width, height, fx, fy, cx, cy, world_to_camera}.  Sizes, focal lengths and principal point are in
px; world_to_camera is 4×4, row by row, OpenCV axes.
"""

from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet
from aaplug.io.cameras.options import Options, every_nth
from aaplug.io.cameras.photos import described_sizes, refuse_folder, scaled_sizes, trained_at
from aaplug.io.values import Entry, entries, inverse, mentions, pose, read_json, rigid


def sniff(path: Path) -> bool:
    """Whether a file's keys are those of a plain pinhole."""
    return mentions(path, ["world_to_camera"])


def read(path: Path, options: Options) -> CameraSet:
    """The cameras; one alone bears its file's name, those of a list their number.

    Raises:
        FormatError: the file is not what it should be.
        UsageError: the options do not fit.
    """
    refuse_folder(options.images)
    document = read_json(path)
    alone = isinstance(document, dict)
    found = entries(path, "camera", [document] if alone else document)
    digits = len(str(len(found) - 1))
    names = [path.stem] if alone else [f"camera_{i:0{digits}}" for i in range(len(found))]
    source = [_camera(entry, name) for entry, name in zip(found, names, strict=True)]
    scale = 1.0 if options.train_scale is None else options.train_scale
    trained = trained_at(source, scaled_sizes(source, scale))
    why = "as in the file" if options.train_scale is None else f"× {scale:g}: --train-scale"
    split = every_nth(trained, options, 0, "the format has no split")
    notes = (
        f"pinhole JSON: {len(source)} cameras, {described_sizes(source)} in the file",
        split.note,
        f"training size: {described_sizes(trained)} ({why})",
    )
    return CameraSet(split.train, split.test, notes=notes)


def _camera(entry: Entry, name: str) -> Camera:
    motion = rigid(entry, "world_to_camera")
    cam_from_world = pose(motion[:3, :3], motion[:3, 3], entry.place, "world_to_camera")
    inverse(cam_from_world, entry.place, "world_to_camera")  # the centre must be within reach
    return Camera(
        name,
        entry.pixels("width"),
        entry.pixels("height"),
        entry.focal("fx"),
        entry.focal("fy"),
        entry.number("cx"),
        entry.number("cy"),
        cam_from_world,
    )
