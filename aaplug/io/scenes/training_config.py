"""How a scene was trained, by the configuration that its trainer left beside it.

nerfstudio's exporter and gsplat's trainer write no tag, but their runs keep a YAML file: nerfstudio's config.yml has a
line `rasterize_mode: classic` or `antialiased`; gsplat's cfg.yml, in the folder above ply/ and ckpts/, has
`antialiased: true` or `false`.  Such a file may hold Python objects, so it is never loaded as YAML: one line is sought
in its first HEAD_LIMIT bytes.
"""

import re
from pathlib import Path

from aaplug.core.errors import FormatError
from aaplug.core.gaussians import ANTIALIASED, CLASSIC, Convention
from aaplug.io.values import HEAD_LIMIT, read_start

NERFSTUDIO_CONFIG, NERFSTUDIO_LINE = "config.yml", re.compile(rb"^[ \t]*rasterize_mode:[ \t]*(\w+)[ \t]*\r?$", re.M)
GSPLAT_CONFIG, GSPLAT_LINE = "cfg.yml", re.compile(rb"^antialiased:[ \t]*(\w+)[ \t]*\r?$", re.M)
GSPLAT_FOLDERS = ("ply", "ckpts")  # of a run, with what its trainer exports
MODES = {b"antialiased": ANTIALIASED, b"true": ANTIALIASED, b"classic": CLASSIC, b"false": CLASSIC}


def nerfstudio_config(scene: Path) -> tuple[Convention, str] | None:
    """What a nerfstudio run's configuration beside the scene says, and the evidence; None if nothing."""
    return _stated(scene.with_name(NERFSTUDIO_CONFIG), NERFSTUDIO_LINE)


def gsplat_config(scene: Path) -> tuple[Convention, str] | None:
    """What the configuration of the gsplat run that holds the scene says, and the evidence; None if nothing."""
    folder = scene.absolute().parent
    return _stated(folder.parent / GSPLAT_CONFIG, GSPLAT_LINE) if folder.name in GSPLAT_FOLDERS else None


def _stated(config: Path, line: re.Pattern[bytes]) -> tuple[Convention, str] | None:
    """The one value that all such lines have."""
    try:
        found = {each.lower() for each in line.findall(read_start(config, HEAD_LIMIT))}
    except FormatError:  # it is not there, or cannot be read
        return None
    convention = MODES.get(found.pop()) if len(found) == 1 else None
    return None if convention is None else (convention, f"{config.name} of its run says {convention.name}")
