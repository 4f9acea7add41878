"""Stages of USD, opened by the package usd-core (the extra `usd`), for cameras and scenes.

What a stage is composed of is looked at before it is composed: files outside of the stage's folder are never read.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from aaplug.system.errors import FormatError, UsageError
from aaplug.system.extras import install_command

SUFFIXES = ("usda", "usdc", "usdz", "usd")
MAX_LAYERS = 1000


def module(name: str) -> Any:
    """A module of the package `usd-core`, whose stubs are not complete."""
    return import_module(f"pxr.{name}")


@contextmanager
def stage_of(path: Path, alone: bool = False) -> Iterator[Any]:
    """The stage of a file.

    alone: refuse one that is composed of several files, a package's own excepted.

    Raises:
        UsageError: usd-core is not installed.
        FormatError: the file breaks its format, or names files elsewhere.
    """
    try:
        Tf, Usd = module("Tf"), module("Usd")
    except ImportError as error:
        raise UsageError("path", f"{path.suffix} files need the extra `usd`: {install_command('usd')}") from error
    try:
        _check_layers(path, alone)
        yield Usd.Stage.Open(str(path))
    except (Tf.ErrorException, UnicodeDecodeError) as error:  # its message may be no text
        raise FormatError(path, "cannot be read: it breaks the format of USD") from error


def _check_layers(path: Path, alone: bool) -> None:
    """Refuse layers outside of the file's folder, or of the file, whoever names them."""
    Sdf, home, left, seen = module("Sdf"), path.parent.resolve(), [str(path)], set[str]()
    while left:
        layer = Sdf.Layer.FindOrOpen(left.pop())
        if layer is None:
            raise FormatError(path, "cannot be read: it is no USD, or a layer that it names is missing")
        for asset in filter(None, layer.GetCompositionAssetDependencies()):
            name = Sdf.ComputeAssetPathRelativeToLayer(layer, asset)
            file, inside, _ = name.partition("[")  # a package's own file stands in brackets
            if alone and not (inside and Path(file).resolve() == path.resolve()):
                raise FormatError(path, f"is composed with another layer, {asset!r}; flatten it into one file")
            if "://" in asset or not Path(os.path.realpath(file)).is_relative_to(home):
                raise FormatError(path, f"names a layer outside of its folder: {asset!r}")
            if name not in seen:
                seen.add(name)
                left.append(name)
        if len(seen) > MAX_LAYERS:
            raise FormatError(path, f"names more than {MAX_LAYERS} layers")
