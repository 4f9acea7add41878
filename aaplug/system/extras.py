"""The packages that only some parts of aaplug need: its extras."""

import importlib.util
import json
import os
import shlex
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distribution
from urllib.parse import urlsplit
from urllib.request import url2pathname

from aaplug.system.errors import UsageError


def check_installed(package: str, extra: str, where: str, problem: str) -> None:
    """Raise UsageError at `where`, with `problem` and the command that helps, if a package of an extra is missing."""
    if importlib.util.find_spec(package) is None:
        raise UsageError(where, f"{problem}: {install_command(extra)}")


def install_command(extra: str) -> str:
    """The command that adds an extra to aaplug as it is installed here: from a folder, an address or the index.

    Where a package came from stands in its `direct_url.json` (PEP 610); one from the index has none.
    """
    origin: dict[str, object] = {}
    with suppress(PackageNotFoundError, ValueError):
        origin = json.loads(distribution("aaplug").read_text("direct_url.json") or "{}")
    match origin:
        case {"url": str(url), "dir_info": {"editable": True}}:
            wanted = "-e", f"{url2pathname(urlsplit(url).path)}[{extra}]"
        case {"url": str(url)}:
            wanted = (f"aaplug[{extra}] @ {url}",)
        case _:
            wanted = (f"aaplug[{extra}]",)
    return command_line(("pip", "install", *wanted))


def command_line(words: Sequence[str]) -> str:
    """Words as one line to copy into a shell of this system."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)
