"""INRIA's `cameras.json`, with the training run's `cfg_args` if that lies beside it.

A list of {id, img_name, width, height, position, rotation, fx, fy}.  position: the camera's centre, in world units;
rotation: camera-to-world, OpenCV axes; fx, fy: in px.  The principal point is the image's centre.  Sizes are those of
the photos before training scaled them, so the training size is computed by 3DGS's rule.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

from aaplug.core.cameras import BLACK, WHITE, Camera, CameraSet
from aaplug.io.cameras import cfg_args
from aaplug.io.cameras.cfg_args import WIDTH_CAP, CfgArgs, half_up, read_cfg_args
from aaplug.io.cameras.options import LLFF_HOLD, Options, Split, every_nth, explicit
from aaplug.io.cameras.photos import photo_folder, with_photos
from aaplug.io.cameras.poses import centred, inverse, pose
from aaplug.io.cameras.sizes import Size, camera_set, file_sizes, photo_sizes, trained_at
from aaplug.io.values import Entry, Place, entries, focal, mentions, pixels, read_json, text

FILE = "cameras.json"

name = "inria"
sign = "cameras.json (INRIA)"


def sniff(path: Path) -> bool:
    """Whether a folder holds cameras.json, or a file is one by its name or keys."""
    if os.path.isdir(path):
        return os.path.isfile(path / FILE)
    return path.name == FILE or mentions(path, ["img_name"])


def read(path: Path, options: Options) -> CameraSet:
    """The cameras at the size at which 3DGS trained."""
    folder = path if os.path.isdir(path) else path.parent
    file = folder / FILE if path == folder or path.name == cfg_args.NAME else path
    found = entries(file, "camera", read_json(file))
    run = folder / cfg_args.NAME
    settings = read_cfg_args(run) if os.path.isfile(run) else None
    photos = photo_folder(folder, options, (settings or CfgArgs()).images, Place(run, "images"))
    source = with_photos([_camera(e) for e in found], [e.place for e in found], photos)
    source = _without_copies(source)
    sizes, why = _training_sizes(source, settings, options)
    trained = trained_at(source, sizes)
    split = _split(trained, settings, options)
    background = {None: None, True: WHITE, False: BLACK}[settings.white_background if settings else None]
    return camera_set("INRIA cameras.json", source, split, why, background)


def _camera(entry: Entry) -> Camera:
    rotation, position = entry.matrix("rotation", 3, 3), entry.vector("position", 3)
    size = entry.get("width", pixels), entry.get("height", pixels)
    focals = entry.get("fx", focal), entry.get("fy", focal)
    cam_from_world = inverse(pose(rotation, position, entry.place, "rotation"), entry.place, "position")
    return centred(entry.get("img_name", text), size, focals, cam_from_world)


def _without_copies(cameras: Sequence[Camera]) -> list[Camera]:
    """Drop repeated views: some runs list a view once per split."""
    first: dict[tuple[object, ...], Camera] = {}
    for camera in cameras:
        first.setdefault((camera.name, *camera.cam_from_world.flatten().tolist()), camera)
    return list(first.values())


def _training_sizes(cameras: Sequence[Camera], settings: CfgArgs | None, options: Options) -> tuple[list[Size], str]:
    if options.train_scale is not None:
        return file_sizes(cameras, options)
    run = settings or CfgArgs()
    base, base_why = _base_sizes(cameras, run)
    rule = f"resolution {run.resolution:g} in cfg_args"
    if settings is None:
        rule = f"3DGS's cap at {WIDTH_CAP} px, assumed without cfg_args: `train_scale` sets it"
    return [run.size(*size) for size in base], f"{base_why}, {rule}"


def _base_sizes(cameras: Sequence[Camera], run: CfgArgs) -> tuple[list[Size], str]:
    """The sizes of the photos that training loaded, before its resolution rule."""
    if any(camera.photo for camera in cameras):
        return photo_sizes(cameras), "size of the photos"
    n = run.divisor
    sizes = [(half_up(camera.width / n), half_up(camera.height / n)) for camera in cameras]
    return sizes, "size in the file" + (f" / {n} for {run.images}" if n > 1 else "")


def _split(cameras: Sequence[Camera], settings: CfgArgs | None, options: Options) -> Split:
    held_out = settings is not None and settings.held_out
    names = [camera.name for camera in cameras]
    second = _second_run(names)
    if held_out and options.test_every is None and second:
        return explicit(cameras[second:], cameras[:second], "names repeat: test views come first")
    ordered = sorted(_renamed(cameras), key=lambda camera: camera.name)
    if settings is None:
        return every_nth(ordered, options, 0, "no cfg_args; `test_every` 8 is 3DGS's rule")
    hold = LLFF_HOLD if held_out else 0
    return every_nth(ordered, options, hold, f"eval={held_out} in cfg_args")


def _second_run(names: Sequence[str]) -> int | None:
    """Index at which the names begin again, if they do once: Blender's test views r_0, ..., then training r_0, ..."""
    if not (start := next((i for i, n in enumerate(_times_met(names)) if n > 1), None)):
        return None
    return start if len(set(names[start:])) == len(names[start:]) else None


def _renamed(cameras: Sequence[Camera]) -> list[Camera]:
    """Append a number to repeated names."""
    times = _times_met([camera.name for camera in cameras])
    return [c if n == 1 else replace(c, name=f"{c.name}~{n}") for c, n in zip(cameras, times, strict=True)]


def _times_met(names: Sequence[str]) -> list[int]:
    """How often each name has occurred up to its place in the list, itself included."""
    met = defaultdict[str, Iterator[int]](lambda: count(1))
    return [next(met[name]) for name in names]
