"""USD scenes: prims of the type ParticleField3DGaussianSplat (UsdVol 26.03), in .usda, .usdc and .usdz.

positions, orientations (real part first), scales (linear), opacities (0 to 1) and
radiance:sphericalHarmonicsCoefficients, (degree + 1)² of them a Gaussian, each as floats or as halves.  The axes of a
stage have y up, as glTF's (see `gltf`), or z.  Transforms are applied, where they turn, move and scale alike along all
axes; units are taken as they are.  USD has no word for a convention: it stays in a record of ours in the stage's
`customLayerData`.

Written are floats, as the stage's default prim, with y up and a metre per unit.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.placing import box_of
from aaplug.io.atomic import replacing_file, told_by_library
from aaplug.io.cameras.usd import module
from aaplug.io.scenes.packed import Piece, floats, half_turn_about_z, logit_of, standing
from aaplug.io.scenes.record import KEY, Facts, read_record, record_of, whole
from aaplug.io.scenes.rows import SceneFileOptions, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.io.values import Entry, Place, natural, parse_json
from aaplug.system.errors import FormatError, OutputError
from aaplug.system.extras import check_installed
from aaplug.system.locks import scratch

SUFFIXES = ("usda", "usdc", "usdz", "usd")
PACKAGE = "pxr"  # of usd-core
SECONDS, BYTES_PER_SECOND = 20.0, 1e6  # that reading a file may take, and its size for each further second
HARMONICS, DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"
TYPE = "ParticleField3DGaussianSplat"
CHILD = Path(__file__).parents[1] / "usd_child.py"  # a program of its own
MAX_DEGREE = 4
ZIP_EPOCH = 315_619_200  # s: 1980-01-02, which a zip holds in every time zone
EXTENT_SIGMAS = 3.0  # from a Gaussian's centre
# from axes with z up to axes with y up and z forward
FROM_Z_UP = torch.tensor([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
EVIDENCE = "USD does not say: assumed classic (3DGS default)"


@dataclass(frozen=True)
class UsdFormat:
    """Files of one suffix.  Raises as `SceneFormat` and `WritableFormat`."""

    name: str
    needs: str = PACKAGE
    keeps: tuple[str, ...] = ("harmonics", "record")
    extra: str = "usd"

    def sniff(self, path: Path, head: bytes) -> bool:
        """True for the suffix: a stage may begin like any text, or like any zip."""
        return path.suffix[1:].lower() == self.name

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """All prims of splats as one scene, in memory; read by `usd_child`."""
        check_installed(PACKAGE, self.extra, "path", f"{path.suffix} files need the extra `usd`")
        with library_errors(path), scratch() as folder:
            command = [sys.executable, str(CHILD), str(path.resolve()), str(file := folder / "arrays.npz")]
            seconds = SECONDS + path.stat().st_size / BYTES_PER_SECOND
            try:
                run = subprocess.run(command, capture_output=True, timeout=seconds, check=True)
            except (subprocess.SubprocessError, ValueError) as error:
                raise FormatError(path, "cannot be read: it breaks the format of USD") from error
            told = parse_json(run.stdout.splitlines()[-1], path)
            with np.load(file) as loaded:
                arrays = dict(loaded)
            if "refused" in told:
                raise FormatError(path, told["refused"])
            prims = enumerate(told["prims"])
            rows = Piece.of([_read(path, prim, number, arrays, told["up"]) for number, prim in prims])
            said = told["record"]
            record = {} if said is None else {KEY: parse_json(said.encode(), path)}
            facts = read_record(path, record, Facts(EVIDENCE))
        return Scene(path, self.name, *rows, *facts)

    def write(
        self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions
    ) -> None:
        """Write a scene as one prim."""
        stage = _stage(half_turn_about_z(whole(path, parts, self.name, MAX_DEGREE)))
        with replacing_file(path, overwrite, f".{self.name}") as temporary, told_by_library():
            if self.name != "usdz":
                done = stage.GetRootLayer().Export(str(temporary))
            else:
                with scratch(str(temporary.parent)) as folder:
                    inner = folder / f"{path.stem}.usdc"
                    done = stage.GetRootLayer().Export(str(inner))
                    os.utime(inner, (ZIP_EPOCH, ZIP_EPOCH))  # the package holds it, and is to be the same each time
                    done = done and module("UsdUtils").CreateNewUsdzPackage(str(inner), str(temporary))
            if not done:
                raise OutputError(path, "cannot be written: usd-core failed")


FORMATS = tuple(UsdFormat(suffix) for suffix in SUFFIXES)


def _read(path: Path, prim: dict[str, Any], number: int, arrays: dict[str, np.ndarray], up: str) -> Gaussians:
    place = Place(path, f"prim {prim['name']}")
    each = (natural(prim["degree"], place, DEGREE, MAX_DEGREE) + 1) ** 2

    def column(name: str, width: int, rows: int | None = None) -> Tensor:
        key = f"{number} {name}"
        place.expect(key in arrays, name, "an array", None)
        fits = arrays[key].dtype.kind == "f" and arrays[key].size == arrays[key].shape[0] * width
        wanted = f"{arrays[key].shape[0] if rows is None else rows:,} values of {width} numbers"
        place.expect(fits and rows in (None, arrays[key].shape[0]), name, wanted, arrays[key].shape)
        return floats(arrays[key]).reshape(-1, width)

    means = column("positions", 3)
    count = len(means)
    turned = column("orientations", 4, count).roll(1, dims=1)  # numpy's view has the real part last
    logits, log_scales = logit_of(column("opacities", 1, count)[:, 0]), column("scales", 3, count).log()
    sh = column(HARMONICS, 3, count * each).reshape(count, each, 3)
    motion = Entry(place, prim).matrix("motion", 4, 4).T
    standing_up = FROM_Z_UP @ motion if up == "Z" else motion
    return standing(Gaussians(means, turned, log_scales, logits, sh), standing_up, place)


def _stage(scene: Gaussians) -> Any:
    """A stage in memory with the scene, which is in its axes."""
    Usd, UsdGeom, Sdf, Vt = (module(name) for name in ("Usd", "UsdGeom", "Sdf", "Vt"))
    stage, types = Usd.Stage.CreateInMemory(), Sdf.ValueTypeNames
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim("/Splats", TYPE)
    stage.SetDefaultPrim(prim)
    stage.GetRootLayer().customLayerData = {KEY: json.dumps(record_of(scene))}
    extent = box_of(scene, EXTENT_SIGMAS)
    triples = Vt.Vec3fArray.FromNumpy
    values = {
        "positions": (types.Point3fArray, triples(scene.means.numpy())),
        "orientations": (types.QuatfArray, Vt.QuatfArray.FromNumpy(scene.unit_quats.roll(-1, dims=1).numpy())),
        "scales": (types.Float3Array, triples(scene.scales.numpy())),
        "opacities": (types.FloatArray, Vt.FloatArray.FromNumpy(scene.opacities.numpy())),
        DEGREE: (types.Int, scene.sh_degree),
        HARMONICS: (types.Float3Array, triples(scene.sh.reshape(-1, 3).contiguous().numpy())),
        "extent": (types.Float3Array, triples(extent.numpy())),
        "projectionModeHint": (types.Token, "perspective"),
        "sortingModeHint": (types.Token, "zDepth"),
    }
    for name, (kind, value) in values.items():
        attribute = prim.GetAttribute(name) or prim.CreateAttribute(name, kind, custom=False)
        attribute.Set(value)
        if name == HARMONICS:
            attribute.SetMetadata("elementSize", scene.sh.shape[1])
    return stage
