"""The convention of a scene's training, by the configuration that its trainer left beside it.

nerfstudio's exporter and gsplat's trainer write no tag, but their runs keep a YAML file: nerfstudio's config.yml has a
line `rasterize_mode: classic` or `antialiased`; gsplat's cfg.yml, in the folder above ply/ and ckpts/, has
`antialiased: true` or `false`.  Such a file may hold Python objects, so it is never loaded as YAML: one line is sought
in its first HEAD_LIMIT bytes.
"""

import re
from pathlib import Path

from aaplug.core.conventions import ANTIALIASED, CLASSIC, Convention
from aaplug.io.values import HEAD_LIMIT, read_start
from aaplug.system.errors import FormatError

NERFSTUDIO_CONFIG, NERFSTUDIO_LINE = "config.yml", re.compile(rb"^[ \t]*rasterize_mode:[ \t]*(\w+)[ \t]*\r?$", re.M)
GSPLAT_CONFIG, GSPLAT_LINE = "cfg.yml", re.compile(rb"^antialiased:[ \t]*(\w+)[ \t]*\r?$", re.M)
GSPLAT_FOLDERS = ("ply", "ckpts")  # of a run, with what its trainer exports
MODES = {b"antialiased": ANTIALIASED, b"true": ANTIALIASED, b"classic": CLASSIC, b"false": CLASSIC}


def run_config(scene: Path, nerfstudio: bool = False) -> tuple[Convention, str] | None:
    """The convention in the configuration of the run that holds the scene, and the evidence; None if it has none."""
    folder = scene.absolute().parent
    config, line = folder / NERFSTUDIO_CONFIG, NERFSTUDIO_LINE
    if not nerfstudio:
        config, line = folder.parent / GSPLAT_CONFIG, GSPLAT_LINE
        if folder.name not in GSPLAT_FOLDERS:
            return None
    try:
        values = {value.lower() for value in line.findall(read_start(config, HEAD_LIMIT))}
    except FormatError:  # it is not there, or cannot be read
        return None
    convention = MODES.get(values.pop()) if len(values) == 1 else None  # the one value that all such lines have
    return None if convention is None else (convention, f"{config.name} of its run says {convention.name}")
