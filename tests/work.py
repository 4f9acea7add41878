"""What tests let workers do, in a file that is imported quickly."""

import os
import signal
from pathlib import Path

from aaplug.system.errors import FormatError


def refuse_three(item: int) -> int:
    """The square; item 3 is refused."""
    if item == 3:
        raise FormatError("scene.ply", "is short")
    return item * item


def deadly_once(mark: Path, item: int) -> int:
    """The square; the first worker of item 2 dies."""
    if item == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item
