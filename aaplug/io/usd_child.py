"""The layers of a USD stage, and as a program of its own its splats: usd-core ends the process at some damaged files.

Words: the file, and one for the arrays.  It prints what it found as a line of JSON; "refused" says why there is
nothing.  Nothing of aaplug is imported, so that it starts at once.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np

Sdf, Usd, UsdGeom = (import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom"))  # its stubs are not complete
TYPE = "ParticleField3DGaussianSplat"
DEGREE = "radiance:sphericalHarmonicsDegree"
ARRAYS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
MEMORY, GROWTH = 2 * 2**30, 20  # bytes of address space beside so many times the file's size


def layers_of(path: str) -> Iterator[tuple[str, str]]:
    """The layers that a stage is composed with, as their files name them, and their files; each is opened after that.

    Raises ValueError for one that cannot be opened, and for value clips: layers that no composition names, which
    reading a value opens.
    """
    left, seen, keys = [path], set[str](), list[str]()
    while left:
        if (layer := Sdf.Layer.FindOrOpen(left.pop())) is None:
            raise ValueError("cannot be read: it is no USD, or a layer that it names is missing")

        def look(path: Any, layer: Any = layer) -> None:
            spec = layer.GetObjectAtPath(path)  # None of a relationship's target
            keys.extend(spec.ListInfoKeys() if spec else ())

        layer.Traverse(Sdf.Path.absoluteRootPath, look)
        if any(key.startswith("clip") for key in keys):
            raise ValueError("has value clips, which are other layers; flatten it into one file")
        for asset in filter(None, layer.GetCompositionAssetDependencies()):
            name = Sdf.ComputeAssetPathRelativeToLayer(layer, asset)
            if name not in seen:
                seen.add(name)
                yield asset, name.partition("[")[0]  # a package's own file stands in brackets
                left.append(name)


def found_in(path: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The stage's facts, and each prim's; its arrays go to `arrays` by number and name."""
    try:
        for asset, file in layers_of(path):
            if os.path.realpath(file) != os.path.realpath(path):
                raise ValueError(f"is composed with another layer, {asset!r}; flatten it into one file")
    except ValueError as error:
        return {"refused": str(error)}
    stage, time = Usd.Stage.Open(path), Usd.TimeCode.EarliestTime()  # the default where nothing moves
    prims = [prim for prim in stage.Traverse() if str(prim.GetTypeName()) == TYPE]
    if not prims:
        return {"refused": f"holds no {TYPE}; is it a mesh?"}
    told = []
    for number, prim in enumerate(prims):
        for name in ARRAYS:
            for each in (name, f"{name}h"):
                value = prim.GetAttribute(each).Get(time) if prim.HasAttribute(each) else None
                if value is not None and len(value):
                    arrays[f"{number} {name}"] = np.asarray(value)
                    break
        placed = UsdGeom.Xformable(prim)
        if not placed:
            return {"refused": f"needs usd-core 26.3 or newer, which knows {TYPE}"}
        motion = placed.ComputeLocalToWorldTransform(time)
        degree = prim.GetAttribute(DEGREE).Get(time)
        told.append({"name": str(prim.GetPath()), "degree": degree, "motion": [list(row) for row in motion]})
    record = stage.GetRootLayer().customLayerData.get("aaplug")
    return {"up": str(UsdGeom.GetStageUpAxis(stage)), "prims": told, "record": None if record is None else str(record)}


if __name__ == "__main__":
    with suppress(ImportError, ValueError, OSError):  # a file that announces more than it can hold fails here
        import resource

        most, (_, hard) = MEMORY + GROWTH * os.path.getsize(sys.argv[1]), resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))
    read: dict[str, np.ndarray] = {}
    answer = found_in(sys.argv[1], read)
    np.savez(sys.argv[2], allow_pickle=False, **read)
    print(json.dumps(answer))
