"""aaplug gather: the shards of a batch become one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import aaplug
from aaplug.core.errors import UsageError

from .console import TERMINAL, out, print_json
from .main import FAILED
from .options import flag


@dataclass(frozen=True)
class Gather:
    """Join the shards of `aaplug evaluate --shard`: write batch.json and results.csv as one machine's run does."""

    folder: Annotated[Path | None, tyro.conf.Positional, flag("FOLDER")] = None
    """The shards' folder of results."""
    overwrite: bool = False
    """Replace the files of an earlier gathering."""
    json: bool = False
    """Print batch.json on stdout instead of the tables."""

    def __call__(self) -> int:
        """Gather, and say which scenes failed."""
        if self.folder is None:
            raise UsageError("gather", "name the folder that the shards wrote: aaplug gather results")
        found = aaplug.gather(self.folder, overwrite=self.overwrite, monitor=TERMINAL)
        if self.json:
            print_json(found.summary())
        else:
            out.print(*found.tables())
        return FAILED if found.failures else 0
