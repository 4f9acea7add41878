"""The packages that only some parts of aaplug need: its extras."""

import importlib.util

from aaplug.system.errors import UsageError


def check_installed(package: str, extra: str, where: str, problem: str) -> None:
    """Raise UsageError at `where`, with `problem` and the command that helps, if a package of an extra is missing."""
    if importlib.util.find_spec(package) is None:
        raise UsageError(where, f"{problem}: {install_command(extra)}")


def install_command(extra: str) -> str:
    """The command that adds an extra to aaplug, wherever it was installed from, in words of every shell."""
    return f'pip install "aaplug[{extra}]"'
