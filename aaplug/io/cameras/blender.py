"""A Blender (NeRF-synthetic) dataset: a folder with `transforms_train.json` and `transforms_test.json`."""

import os
from dataclasses import replace
from pathlib import Path

from aaplug.core.cameras import CameraSet
from aaplug.io.cameras import transforms
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.io.cameras.transforms import Source, read_source, set_of
from aaplug.system.errors import UsageError

TRAIN, TEST, VAL = (f"transforms_{split}.json" for split in ("train", "test", "val"))

name = "blender"
sign = "transforms_train.json (Blender)"


def sniff(path: Path) -> bool:
    """True for a folder with training views."""
    return os.path.isfile(path / TRAIN)


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras, with the split that the files give."""
    if not os.path.isfile(path / TEST):
        cameras = transforms.read(path / TRAIN, options)
    elif options.test_every is not None:
        raise UsageError("test_every", f"{path / TEST} gives the split; leave it out")
    else:
        train, test = (read_source(path / file, options) for file in (TRAIN, TEST))
        held_out = [False] * len(train.cameras) + [True] * len(test.cameras)
        both = Source(train.cameras + test.cameras, held_out, tuple(dict.fromkeys(train.notes + test.notes)))
        cameras = set_of(both, options, f"{TRAIN} and {TEST}")
    more = (f"{VAL} is not read",) if os.path.isfile(path / VAL) else ()
    return replace(cameras, notes=cameras.notes + more)
