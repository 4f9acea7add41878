"""Every registered reader with damaged files, by noise of bytes and by changes of structure, in small children.

Each file must end as what it holds or as one line of error, within the limits of `tests.hostile`.
"""

import io
import json
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import torch

import aaplug.verbs.evaluate  # noqa: F401  (imports the verbs before the children are forked)
from aaplug.evaluation.journal import HASH, Journal
from aaplug.finetuning.state import begin, load, save
from aaplug.io.batch_file import read_batch
from aaplug.io.cameras import CAMERA_FORMATS, read_camera_path, read_cameras
from aaplug.io.images import read_image, read_rgba
from aaplug.io.scenes import SCENE_FORMATS, WritableFormat, sog, write_scene
from aaplug.system.digests import digest_of_values
from tests.bench import heading, row
from tests.conftest import make_scene
from tests.hostile import NAMES, Target, check, mutations, read_as_info_does, scene
from tests.mutators import structured
from tests.scene_files import write_file, write_json
from tests.test_batch import SETTINGS
from tests.test_camera_paths import document
from tests.test_cameras_io import EXPORTED, FIXTURES
from tests.test_finetuning import make_job
from tests.test_path_formats import SETTINGS as VIEWER_SETTINGS
from tests.test_path_formats import TIMELINE, USDA, glb, gltf_with_buffer

SMALL_IMAGES = {"AAPLUG_IMAGE": "2000000", "AAPLUG_IMAGE_EXTRA": "1000000"}  # so that the children's memory suffices
IMAGES = {
    "PNG": (".png", np.uint8, 3),
    "PNG, 16 bits, alpha": (".png", np.uint16, 4),
    "JPEG": (".jpg", np.uint8, 3),
    "WebP": (".webp", np.uint8, 4),
    "TIFF": (".tiff", np.uint16, 3),
    "BMP": (".bmp", np.uint8, 3),
}
EXR = b"\x76\x2f\x31\x01\x02\x00\x00\x00channels\0chlist\0" + bytes(200)  # the start of one, which is refused
VIEW = {"view": 0, "measurements": []}
JOURNAL = "".join(
    json.dumps(each) + "\n" for each in ({"request": {"views": 1}}, VIEW | {HASH: digest_of_values(VIEW)})
)


def main(mutations: int = 100_000, seed: int = 0, only: str = "") -> None:
    """Damage each reader's file so often that there are so many files in all; print what became of them.

    only: a part of the names of readers.
    """
    logging.getLogger("aaplug").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    every = {**scenes(), **cameras(), **paths(), **others()}
    targets = {name: target for name, target in every.items() if only in name}
    each, total = -(-mutations // len(targets)), Counter[str]()
    heading("damaged files", "reader", "read", "refused", "s")
    for name, target in targets.items():
        started = time.perf_counter()
        outcomes = damaged(name, target, each, seed)
        total += outcomes
        row(name, outcomes["read"], outcomes["refused"], round(time.perf_counter() - started))
    row("all", total["read"], total["refused"], "")


def damaged(name: str, target: Target, count: int, seed: int) -> Counter[str]:
    """Outcomes of a file and its mutations, half of each kind."""
    content = target.content()
    noise = mutations(content, seed, count // 2)
    return check(name, chain([content], noise, structured(content, seed, count - 1 - count // 2)), target)


def scenes() -> dict[str, Target]:
    """The small scenes of the tests, and one of each other registered format that can be written."""
    targets = {f"scene {name}": scene(name) for name in NAMES}
    index = Target(
        lambda f: write_file(f, "scene.lcc").with_name("Index.bin"),
        lambda p: read_as_info_does(p.with_name("scene.lcc")),
    )
    targets["scene scene.lcc, its index"] = index
    for format in SCENE_FORMATS.values():
        if isinstance(format, WritableFormat) and find_spec(getattr(format, "needs", None) or "aaplug"):
            targets.setdefault(f"scene of {format.name}", Target(_written(format.name), read_as_info_does))
    return targets


def _written(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / (suffix if suffix == sog.META else f"scene.{suffix}")
        write_scene(path, make_scene(20))
        return path

    return make


def cameras() -> dict[str, Target]:
    """The small sets of cameras of the tests, which cover all registered formats but those of plug-ins."""
    targets = {f"cameras {name}": _camera_target(*fixture) for name, fixture in FIXTURES.items()}
    for name in CAMERA_FORMATS.keys() - FIXTURES.keys():
        print(f"camera format {name}: no file to damage")
    exported = Target(lambda folder: write_json(folder / "transforms_train.json", [EXPORTED]), read_cameras)
    np.save(objects := io.BytesIO(), np.array([{"a": os.getcwd}], object), allow_pickle=True)  # which would run code
    hidden = _file("poses_bounds.npy", objects.getvalue())
    return {**targets, "cameras of ns-export": exported, "cameras of objects": hidden}


def paths() -> dict[str, Target]:
    """Camera paths of other programs, and one with an aperture."""
    aperture = {"radius": 0.01, "focus": 3.0, "blades": 5}
    frame = document()["camera_path"][0] | {"aperture": aperture}
    files = {
        "path.json": json.dumps(document(shutter=0.5, camera_path=[frame, frame])),
        "settings.json": json.dumps(VIEWER_SETTINGS),
        "timeline.json": json.dumps(TIMELINE),
        **({"path.usda": USDA} if find_spec("pxr") else {}),
    }
    return {
        **{f"path {name}": _file(name, text.encode(), read_camera_path) for name, text in files.items()},
        "path path.glb": Target(glb, read_camera_path),
        "path path.gltf": Target(gltf_with_buffer, read_camera_path),
    }


def _camera_target(make: Callable[[Path], Path], part: str) -> Target:
    """part: the damaged file of a folder; "" where the format is one file."""
    return Target(
        lambda folder: make(folder) / part if part else make(folder),
        lambda path: read_cameras(path.parent if part else path),
    )


def others() -> dict[str, Target]:
    """Images, a batch file, a checkpoint of fine-tuning and an evaluation's journal."""
    job = make_job(5)

    def checkpoint(folder: Path) -> Path:
        save(folder / "run.pt", job, begin(job))
        return folder / "run.pt"

    def resume(path: Path) -> None:
        with Journal(path, {"views": 1}, resume=True):
            pass

    return {
        **{f"image {name}": _image(*how) for name, how in IMAGES.items()},
        "image EXR": _file("photo.exr", EXR, read_image, SMALL_IMAGES),
        "batch file": _file("batch.toml", SETTINGS.encode(), read_batch),
        "checkpoint": Target(checkpoint, lambda path: load(path, job)),
        "journal": _file("progress.jsonl", JOURNAL.encode(), resume),
    }


def _image(suffix: str, depth: type[np.unsignedinteger], channels: int) -> Target:
    """A small photograph of a format."""
    pixels = np.random.default_rng(0).integers(0, np.iinfo(depth).max, (12, 16, channels), depth)
    _, data = cv2.imencode(suffix, pixels)
    return _file(f"photo{suffix}", data.tobytes(), read_rgba if channels > 3 else read_image, SMALL_IMAGES)


def _file(
    name: str,
    content: bytes,
    read: Callable[[Path], object] = lambda path: read_cameras(path.parent),
    environment: Mapping[str, str] | None = None,
) -> Target:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return Target(make, read, environment or {})
