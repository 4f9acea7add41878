"""INRIA's `cameras.json`, with the training run's `cfg_args` if that lies beside it.

A list of {id, img_name, width, height, position, rotation, fx, fy}.  position: the camera's centre, in world units;
rotation: camera-to-world, OpenCV axes; fx, fy: in px.  The principal point is the image's centre.  Sizes are those of
the photos before training scaled them, so the training size is computed by 3DGS's rule.

cfg_args is the text of a Python `Namespace(...)`.  It comes with downloaded scenes, so it is parsed and never
evaluated: one call of `Namespace` whose keywords are literals.  `source_path` names a folder, maybe of another machine:
it is told, and nothing in it is read.
"""

import ast
import math
import os
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet, centred, photographs, rigid_motion
from aaplug.core.colours import BLACK, WHITE
from aaplug.io.cameras import sets
from aaplug.io.cameras.photos import photo_folder, without_suffix
from aaplug.io.cameras.poses import inverse, pose
from aaplug.io.cameras.sets import WIDTH_CAP, CameraFileOptions
from aaplug.io.limits import whole_limit
from aaplug.io.values import Entry, Place, entries, focal, mentions, number, pixels, read_bounded, read_json, text
from aaplug.system.errors import FormatError

FILE, CFG_ARGS = "cameras.json", "cfg_args"
CAPPED = -1.0  # 3DGS's default resolution: the width capped at WIDTH_CAP
DIVISORS = (1, 2, 4, 8)  # resolutions that divide the size; others are a width in px

name = "inria"
sign = "cameras.json (INRIA)"


@dataclass(frozen=True)
class CfgArgs:
    """A run's settings that concern its images.

    resolution: a divisor in DIVISORS, CAPPED, or a width in px.
    images: the folder of the photos, in the data set `source`, which is empty if the file does not say.
    white_background: None if the file does not say.
    held_out: true if every 8th view was kept from training (eval).
    """

    resolution: float = CAPPED
    images: str = "images"
    source: str = ""
    white_background: bool | None = None
    held_out: bool = False

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The size at which 3DGS trains on an image of this size."""
        if self.resolution in DIVISORS:
            return max(1, round(width / self.resolution)), max(1, round(height / self.resolution))
        target = min(width, WIDTH_CAP) if self.resolution == CAPPED else int(self.resolution)
        return target, max(1, height * target // width)  # 3DGS truncates here, and rounds above


UNKNOWN = CfgArgs()  # of a run without the file


def read_cfg_args(path: Path) -> CfgArgs:
    """Read the settings that concern cameras; those that the file does not mention have their defaults.

    Raises FormatError for a file that breaks its format.
    """
    source, settings = read_bounded(path, whole_limit("CFG_ARGS")), {}
    try:
        with warnings.catch_warnings(action="ignore"):  # Python's, about backslashes in Windows paths
            call = ast.parse(source.decode().strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise FormatError(path, f"should be a Python Namespace(...): {error}") from error
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
        raise FormatError(path, "should be a Python Namespace(...)")
    if call.func.id != "Namespace" or call.args or not all(keyword.arg for keyword in call.keywords):
        raise FormatError(path, f"should be Namespace(name=value, ...), not {call.func.id}(...)")
    for keyword in call.keywords:
        try:
            settings[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
            problem = f"{keyword.arg} should be a literal (number, text, True, list); code is never run"
            raise FormatError(path, problem) from error
    entry, most = Entry(Place(path, "Namespace"), settings), whole_limit("CAMERA_SIDE")
    resolution = entry.get("resolution", number, CAPPED)
    right = resolution == CAPPED or 1 <= resolution <= most
    entry.place.expect(right, "resolution", f"-1, 1, 2, 4, 8 or a width up to {most} px", resolution)
    white, held_out = (settings.get(field) for field in ("white_background", "eval"))
    for field, value in (("white_background", white), ("eval", held_out)):
        entry.place.expect(value is None or isinstance(value, bool), field, "True or False", value)
    images, source = entry.get("images", text, CfgArgs.images), settings.get("source_path")
    return CfgArgs(resolution, images, source if isinstance(source, str) else "", white, bool(held_out))


def sniff(path: Path) -> bool:
    """True for a folder that holds cameras.json, and for a file that is one by its name or keys."""
    if os.path.isdir(path):
        return os.path.isfile(path / FILE)
    return path.name == FILE or mentions(path, ["img_name"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras at the size at which 3DGS trained."""
    folder = path if os.path.isdir(path) else path.parent
    file = folder / FILE if path == folder or path.name == CFG_ARGS else path
    items = entries(file, "camera", read_json(file))
    run = folder / CFG_ARGS
    settings = read_cfg_args(run) if os.path.isfile(run) else UNKNOWN
    photos = photo_folder(folder, options, settings.images, Place(run, "images"))
    source = list[Camera]()
    for item in items:
        rotation, position = item.matrix("rotation", 3, 3), item.vector("position", 3)
        size = item.get("width", pixels), item.get("height", pixels)
        fx, fy = item.get("fx", focal), item.get("fy", focal)
        cam_from_world = inverse(pose(rigid_motion(rotation, position), item.place, "rotation"))
        name = item.get("img_name", text)
        source.append(replace(centred(name, size, fx, cam_from_world, photos.find(name, item.place)), fy=fy))
    photos.check(source)
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
        folder = path.parent if path.name == CFG_ARGS else path
        return all(os.path.isfile(folder / file) for file in (FILE, CFG_ARGS))


def _trained(cameras: Sequence[Camera], run: CfgArgs, options: CameraFileOptions) -> tuple[list[Camera], str]:
    """The cameras at 3DGS's sizes, by its rule, of the photos that training loaded; and why, for a note."""
    if options.train_scale is not None:
        return sets.at_train_scale(cameras, options)
    divided = re.search(r"_([1-9][0-9]?)$", run.images)  # such as images_4
    n = int(divided[1]) if divided else 1
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
