"""Batch files as options: each setting is read as the option of its name, so that both mean the same."""

from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import tyro

from aaplug.core.errors import FormatError, UsageError, did_you_mean
from aaplug.io.batch_file import read_batch

from .options import CONFIG, one_line, option_types

NOT_IN_A_FILE = ("batch", "more", "shard", "json", "resume", "overwrite", "keep")
ONCE = ("output", "threads", "memory", "rasterizer", "scheduler")  # for the whole batch, not for one scene

T = TypeVar("T")


def scenes_of(path: Path, base: T) -> list[tuple[str, T]]:
    """The scenes of a batch file with their options; `base` has what the file does not say."""
    file, refused = read_batch(path), (*NOT_IN_A_FILE, *ONCE)
    shared = _set(path, "at the top", base, file.shared, NOT_IN_A_FILE)
    return [(name, _set(path, f"scene '{name}'", shared, settings, refused)) for name, settings in file.scenes.items()]


def _set(path: Path, where: str, options: T, settings: Mapping[str, Any], refused: Sequence[str]) -> T:
    """The options with a table's settings."""
    known = [key for key in option_types(type(options)) if key not in refused]
    for key, value in settings.items():
        if key not in known:
            raise FormatError(path, f"{where}: {key} is no setting here{did_you_mean(key, known)}")
        if value is False:
            options = _off(options, key)
            continue
        try:
            with one_line(f"aaplug {type(options).__name__.lower()}"):
                options = tyro.cli(type(options), args=_words(key, value), default=options, config=CONFIG)
        except UsageError as error:
            raise FormatError(path, f"{where}: {error}") from error
    return options


def _off(options: Any, key: str) -> Any:
    """The options with a switch turned off, for which the command line has no word."""
    if isinstance(getattr(options, key, None), bool):
        return replace(options, **{key: False})
    groups = {n: _off(group, key) for n, group in vars(options).items() if is_dataclass(group)}
    return replace(options, **groups)


def _words(key: str, value: Any) -> list[str]:
    """A setting as words of the command line."""
    if key == "scene":
        return [str(value)]
    name = "--" + key.replace("_", "-")
    if value is True:
        return [name]
    return [name, *map(str, value if isinstance(value, list) else [value])]
