"""Batch files: TOML that names scenes and how to evaluate each.

Keys at the top hold for every scene; a [[scene]] table names one scene and may set its own.  Keys are the options of
`aaplug evaluate`; this module does not know them.  It reads the tables and resolves relative paths against the file.
"""

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aaplug.io.atomic import AnyPath
from aaplug.io.values import read_bounded
from aaplug.system.errors import FormatError

MAX_SIZE = 2**20  # bytes: thousands of scenes
PATH_KEYS = ("scene", "model_path", "cameras", "output", "lpips")


def read_batch(path: AnyPath) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The settings of all scenes, and each scene's own by its name, or else that of its file or folder.

    Keys have underscores.

    Raises FormatError if it is not TOML, names no scene, or names two scenes alike.
    """
    path = Path(path)
    try:
        document = tomllib.loads(read_bounded(path, MAX_SIZE).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"should be TOML: {error}") from error
    tables = document.pop("scene", None)
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise FormatError(path, "names no scene; it needs a [[scene]] table for each")
    scenes: dict[str, dict[str, Any]] = {}
    for number, table in enumerate(tables, start=1):
        settings = _settings(table, path.parent)
        file = settings.get("scene") or settings.get("model_path")
        name = settings.pop("name", None)
        if not name and not isinstance(file, str):
            raise FormatError(path, f"[[scene]] {number}: names no scene; add scene = ... as text")
        name = name or Path(str(file)).stem or file
        if not isinstance(name, str) or name.casefold() in map(str.casefold, scenes):
            raise FormatError(path, f"[[scene]] {number}: needs a name of its own, not {name!r}; add name = ...")
        scenes[name] = settings
    return _settings(document, path.parent), scenes


def _settings(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The table with underscores in its keys, and relative paths resolved against `folder`."""
    settings = {key.replace("-", "_"): value for key, value in table.items()}
    return {k: _resolved(v, folder) if k in PATH_KEYS else v for k, v in settings.items()}


def _resolved(value: Any, folder: Path) -> Any:
    if isinstance(value, list):
        return [_resolved(item, folder) for item in value]
    return str(folder / os.path.expanduser(value)) if isinstance(value, str) else value
