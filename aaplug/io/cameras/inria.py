"""INRIA's `cameras.json`, with the training run's `cfg_args` if that lies beside it.

A list of {id, img_name, width, height, position, rotation, fx, fy}.  position: the camera's centre, in world units;
rotation: camera-to-world, OpenCV axes; fx, fy: in px.  The principal point is the image's centre.  Sizes are those of
the photos before training scaled them, so the training size is computed by 3DGS's rule.
"""

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet, centred, photographs
from aaplug.core.colours import BLACK, WHITE
from aaplug.io.cameras import cfg_args, sets
from aaplug.io.cameras.cfg_args import UNKNOWN, WIDTH_CAP, CfgArgs, read_cfg_args
from aaplug.io.cameras.photos import photo_folder, with_photos, without_suffix
from aaplug.io.cameras.poses import inverse, pose
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.io.values import Place, entries, focal, mentions, pixels, read_json, text

FILE = "cameras.json"

name = "inria"
sign = "cameras.json (INRIA)"


def sniff(path: Path) -> bool:
    """True for a folder that holds cameras.json, and for a file that is one by its name or keys."""
    if os.path.isdir(path):
        return os.path.isfile(path / FILE)
    return path.name == FILE or mentions(path, ["img_name"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras at the size at which 3DGS trained."""
    folder = path if os.path.isdir(path) else path.parent
    file = folder / FILE if path == folder or path.name == cfg_args.NAME else path
    items = entries(file, "camera", read_json(file))
    run = folder / cfg_args.NAME
    settings = read_cfg_args(run) if os.path.isfile(run) else UNKNOWN
    photos = photo_folder(folder, options, settings.images, Place(run, "images"))
    source = list[Camera]()
    for item in items:
        rotation, position = item.matrix("rotation", 3, 3), item.vector("position", 3)
        size = item.get("width", pixels), item.get("height", pixels)
        fx, fy = item.get("fx", focal), item.get("fy", focal)
        cam_from_world = inverse(pose(rotation, position, item.place, "rotation"))
        source.append(replace(centred(item.get("img_name", text), size, fx, cam_from_world), fy=fy))
    source = with_photos(source, [item.place for item in items], photos)
    views = dict[tuple[object, ...], Camera]()
    for camera in source:  # some runs list a view once per split
        views.setdefault((camera.name, *camera.cam_from_world.flatten().tolist()), camera)
    source = list(views.values())
    short = [without_suffix(camera.name) for camera in source]
    if len({*short}) == len({camera.name for camera in source}):
        source = [replace(camera, name=name) for camera, name in zip(source, short, strict=True)]
    trained, why = _trained(source, settings, options)
    split = _split(trained, settings, options)
    background = {None: None, True: WHITE, False: BLACK}[settings.white_background]
    missing = f"photos: none found; training had them in {settings.source}/{settings.images}; `images` names a folder"
    more = [missing] if settings.source and not photographs(source) else []
    return sets.camera_set("INRIA cameras.json", source, split, why, background, more)


class Model:
    """A 3DGS model folder, `cameras.json` with `cfg_args`: recognized before a COLMAP dataset in the same folder.

    Only the model tells the training size.
    """

    name = "inria_model"
    sign = "cameras.json with cfg_args (INRIA)"
    read = staticmethod(read)

    @staticmethod
    def sniff(path: Path) -> bool:
        """True for a folder that holds both files, or its cfg_args."""
        folder = path.parent if path.name == cfg_args.NAME else path
        return all(os.path.isfile(folder / file) for file in (FILE, cfg_args.NAME))


def _trained(cameras: Sequence[Camera], run: CfgArgs, options: CameraFileOptions) -> tuple[list[Camera], str]:
    """The cameras at 3DGS's sizes, by its rule, of the photos that training loaded; and why, for a note."""
    if options.train_scale is not None:
        return sets.at_train_scale(cameras, options)
    n = run.divisor
    if photographs(cameras):
        loaded, why = sets.photo_sizes(cameras), "size of the photos"
    else:  # tools that make images_N folders round halves up; Python rounds them to even
        loaded = [tuple(max(1, math.floor(side / n + 0.5)) for side in (c.width, c.height)) for c in cameras]
        why = "size in the file" + (f" / {n} for {run.images}" if n > 1 else "")
    rule = f"resolution {run.resolution:g} in cfg_args"
    if run is UNKNOWN:
        rule = f"3DGS's cap at {WIDTH_CAP} px, assumed without cfg_args: `train_scale` sets it"
    return sets.trained_at(cameras, [run.size(*size) for size in loaded]), f"{why}, {rule}"


def _split(cameras: Sequence[Camera], run: CfgArgs, options: CameraFileOptions) -> CameraSet:
    """The split by name, or by order where the names begin again: Blender's test views r_0, ..., then training's."""
    counts, occurrences = Counter[str](), list[int]()
    for camera in cameras:
        counts[camera.name] += 1
        occurrences.append(counts[camera.name])
    second = next((index for index, times in enumerate(occurrences) if times > 1), len(cameras))
    again = [camera.name for camera in cameras[second:]]
    if run.held_out and options.test_every is None and again and len(set(again)) == len(again):
        return sets.explicit(cameras[second:], cameras[:second], "names repeat: test views come first")
    pairs = zip(cameras, occurrences, strict=True)
    renamed = [camera if times == 1 else replace(camera, name=f"{camera.name}~{times}") for camera, times in pairs]
    ordered = sorted(renamed, key=lambda camera: camera.name)
    reason = "no cfg_args; `test_every` 8 is 3DGS's rule" if run is UNKNOWN else f"eval={run.held_out} in cfg_args"
    return sets.every_nth(ordered, options, sets.LLFF_HOLD if run.held_out else 0, reason)
