"""Every reader, with damaged files in children of bounded memory."""

import io
import json
import logging
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from aaplug.evaluation.journal import Journal
from aaplug.finetuning.state import begin, load, save
from aaplug.io.batch_file import read_batch
from aaplug.io.cameras import read_cameras
from aaplug.io.images import read_image, read_rgba
from aaplug.verbs.inputs import inputs_of  # noqa: F401  (imports the verbs before the children are forked)
from tests.hostile import NAMES, Target, check, mutations, scene
from tests.test_batch import SETTINGS
from tests.test_cameras_io import EXPORTED, FIXTURES, write_json
from tests.test_finetuning import make_job

SMALL_IMAGES = {"AAPLUG_IMAGE": "2000000", "AAPLUG_IMAGE_EXTRA": "1000000"}  # so that the children's memory suffices


def file_of(name: str, content: bytes) -> Callable[[Path], Path]:
    """Writes one file."""

    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return make


def cameras(name: str) -> Target:
    """A small set of cameras of a format."""
    make, spoil = FIXTURES[name]
    return Target(
        lambda folder: make(folder) / spoil if spoil else make(folder),
        lambda path: read_cameras(path.parent if spoil else path),
    )


def image(suffix: str, depth: type[np.unsignedinteger], channels: int) -> Target:
    """A small photograph of a format."""
    pixels = np.random.default_rng(0).integers(0, np.iinfo(depth).max, (12, 16, channels), depth)
    _, data = cv2.imencode(suffix, pixels)
    read = read_rgba if channels > 3 else read_image
    return Target(file_of(f"photo{suffix}", data.tobytes()), read, SMALL_IMAGES)


def exported(folder: Path) -> Path:
    """A list as `ns-export cameras` writes it."""
    return write_json(folder / "transforms_train.json", [EXPORTED])


def checkpoint(folder: Path) -> Path:
    """A checkpoint of fine-tuning."""
    job = make_job(5)
    save(folder / "run.pt", job, begin(job), {})
    return folder / "run.pt"


def journal(path: Path) -> None:
    """Continue an evaluation."""
    with Journal(path, {"views": 1}, resume=True):
        pass


def exr() -> bytes:
    """The start of an OpenEXR file, which is refused."""
    return b"\x76\x2f\x31\x01\x02\x00\x00\x00channels\0chlist\0" + bytes(200)


def npy() -> bytes:
    """A NumPy file of objects, which would run code."""
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": os.getcwd}], object), allow_pickle=True)
    return stream.getvalue()


LINES = json.dumps({"request": {"views": 1}}) + "\n" + json.dumps({"view": 0, "measurements": []}) + "\n"
TARGETS = {
    **{f"image {n}": image(*how) for n, how in {
        "PNG": (".png", np.uint8, 3), "PNG, 16 bits, alpha": (".png", np.uint16, 4), "JPEG": (".jpg", np.uint8, 3),
        "WebP": (".webp", np.uint8, 4), "TIFF": (".tiff", np.uint16, 3), "BMP": (".bmp", np.uint8, 3),
    }.items()},
    "image EXR": Target(file_of("photo.exr", exr()), read_image, SMALL_IMAGES),
    **{f"cameras {name}": cameras(name) for name in FIXTURES},
    "cameras of ns-export": Target(exported, lambda path: read_cameras(path)),
    "cameras of objects": Target(file_of("poses_bounds.npy", npy()), lambda path: read_cameras(path.parent)),
    "batch file": Target(file_of("batch.toml", SETTINGS.encode()), read_batch),
    "checkpoint": Target(checkpoint, lambda path: load(path, JOB)),
    "journal": Target(file_of("progress.jsonl", LINES.encode()), journal),
    **{f"scene {name}": scene(name) for name in NAMES},
}  # fmt: skip
REFUSED = ("image EXR", "cameras of objects")
JOB = make_job(5)
logging.getLogger("aaplug").setLevel(logging.ERROR)


def run(count: int, seed: int) -> Counter[str]:
    """Damage each target so often that there are `count` files in all; prints a line a target."""
    torch.set_num_threads(1)
    each, total = -(-count // len(TARGETS)), Counter[str]()
    for name, target in TARGETS.items():
        started = time.perf_counter()
        whole = target.content()
        found = check(name, [whole, *mutations(whole, seed, each - 1)], target)
        assert found["read"] or name in REFUSED, name
        total += found
        print(f"  {name}: {dict(found)}, {time.perf_counter() - started:.0f} s", flush=True)
    return total
