"""A 3DGS model folder: `cameras.json` with the training run's `cfg_args` beside it.

Read as by `inria`, but recognized before a COLMAP dataset in the same folder: only the model tells the training size.
"""

import os
from pathlib import Path

from aaplug.io.cameras import cfg_args
from aaplug.io.cameras.inria import FILE
from aaplug.io.cameras.inria import read as read

name = "inria_model"
sign = "cameras.json with cfg_args (INRIA)"


def sniff(path: Path) -> bool:
    """True for a folder that holds both files, or its cfg_args."""
    folder = path.parent if path.name == cfg_args.NAME else path
    return all(os.path.isfile(folder / file) for file in (FILE, cfg_args.NAME))
