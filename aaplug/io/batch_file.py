"""Batch files: TOML that names scenes and how each is evaluated.

Keys at the top hold for every scene; a [[scene]] table names one and may set its own.  What the keys mean is the
command line's to say, whose flags they are: here they are only found, and paths made to start at the file.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aaplug.core.errors import FormatError
from aaplug.io.values import read_bounded

LIMIT = 2**20  # bytes: thousands of scenes
SCENES = "scene"
PATHS = ("scene", "model_path", "cameras", "output", "lpips")  # keys whose values are paths


@dataclass(frozen=True)
class BatchFile:
    """Settings of all scenes, and of each scene by its name."""

    shared: Mapping[str, Any]
    scenes: Mapping[str, Mapping[str, Any]]


def read_batch(path: Path) -> BatchFile:
    """Read a batch file; a scene without a name has its file's or folder's.

    Raises:
        FormatError: it is not TOML, names no scene, or one name twice.
    """
    try:
        document = tomllib.loads(read_bounded(path, LIMIT).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"should be TOML: {error}") from error
    tables = document.pop(SCENES, None)
    if not isinstance(tables, list) or not tables or not all(isinstance(t, dict) for t in tables):
        raise FormatError(path, "names no scene; it needs a [[scene]] table for each")
    scenes: dict[str, Mapping[str, Any]] = {}
    for number, table in enumerate(tables, start=1):
        settings = {key.replace("-", "_"): value for key, value in table.items()}
        name = settings.pop("name", None) or _own_name(path, number, settings)
        if not isinstance(name, str) or name.casefold() in (known.casefold() for known in scenes):
            raise FormatError(
                path, f"[[scene]] {number}: needs a name of its own, not {name!r}; add name = ..."
            )
        scenes[name] = _located(settings, path.parent)
    shared = {key.replace("-", "_"): value for key, value in document.items()}
    return BatchFile(_located(shared, path.parent), scenes)


def _own_name(path: Path, number: int, settings: Mapping[str, Any]) -> str:
    file = settings.get("scene") or settings.get("model_path")
    if not isinstance(file, str):
        raise FormatError(path, f"[[scene]] {number}: names no scene; add scene = ... as text")
    return Path(file).stem or file


def _located(settings: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The settings with relative paths starting at the folder."""

    def located(value: Any) -> Any:
        if isinstance(value, list):
            return [located(item) for item in value]
        return str(folder / value) if isinstance(value, str) else value

    return {key: located(value) if key in PATHS else value for key, value in settings.items()}
