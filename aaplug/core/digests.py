"""Hashes (SHA-256, in hex) of what a result depends on, so that a continued run can tell whether anything changed."""

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from os import PathLike

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians

ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")  # in the text of a function or of an object without a text of its own


def digest_of_files(paths: Iterable[str | PathLike[str]]) -> str:
    """Hash of the files' contents, one after another.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as stream:
            hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest()


def digest_of_cameras(views: Sequence[Camera]) -> str:
    """Hash of the views as they were understood: names, sizes, intrinsics, poses, training focal lengths and lenses."""
    understood = [
        [v.name, *v.intrinsics, v.cam_from_world.tolist(), v.trained_focal, v.lens and asdict(v.lens)] for v in views
    ]
    return hashlib.sha256(json.dumps(understood).encode()).hexdigest()


def digest_of_values(value: object) -> str:
    """Hash of dataclasses, names and numbers by their text; functions in it count by name, not by address."""
    return hashlib.sha256(ADDRESS.sub("", repr(value)).encode()).hexdigest()


def digest_of_scene(scene: Gaussians) -> str:
    """Hash of the Gaussians, with everything that they are drawn by."""
    digest = hashlib.sha256(repr((scene.convention, scene.fused, scene.flat)).encode())
    sizes = {} if scene.pixel_sizes is None else vars(scene.pixel_sizes)
    for name, column in (scene.columns | sizes).items():
        digest.update(f"{name} {tuple(column.shape)} {column.dtype}".encode())
        digest.update(column.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
