"""USD scenes: prims of the type ParticleField3DGaussianSplat (UsdVol 26.03), in .usda, .usdc and .usdz.

positions, orientations (real part first), scales (linear), opacities (0 to 1) and
radiance:sphericalHarmonicsCoefficients, (degree + 1)² of them a Gaussian, each as floats or as halves.  The axes of a
stage have y up, as glTF's (see `gltf`), or z.  Transforms are applied, where they turn, move and scale alike along all
axes; units are taken as they are.  USD has no word for a convention: it stays in a record of ours in the stage's
`customLayerData`.

Written are floats, as the stage's default prim, with y up and a metre per unit.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aaplug.core.gaussians import Gaussians, joined
from aaplug.io.atomic import replacing_file
from aaplug.io.scenes.options import SceneFileOptions
from aaplug.io.scenes.packed import floats, half_turn_about_z, of_degree, standing
from aaplug.io.scenes.record import KEY, Facts, holdable, read_record, record_of
from aaplug.io.scenes.scene import Scene, check_count, library_errors, logit_of
from aaplug.io.usd import SUFFIXES, module, stage_of
from aaplug.io.values import Place, parse_json
from aaplug.system.errors import FormatError, OutputError

TYPE = "ParticleField3DGaussianSplat"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"
DEGREE = "radiance:sphericalHarmonicsDegree"
WIDTHS = {"positions": 3, "orientations": 4, "scales": 3, "opacities": 1, HARMONICS: 3}
MAX_DEGREE = 4
EXTENT_SIGMAS = 3.0  # from a Gaussian's centre
# from axes with z up to axes with y up and z forward
FROM_Z_UP = torch.tensor([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
EVIDENCE = "USD does not say: assumed classic (3DGS default)"


@dataclass(frozen=True)
class UsdFormat:
    """Files of one suffix.  Raises as `SceneFormat` and `WritableFormat`."""

    name: str
    needs: str | None = "pxr"
    extra: str = "usd"

    def sniff(self, path: Path, head: bytes) -> bool:
        """True for the suffix: a stage may begin like any text, or like any zip."""
        return path.suffix[1:].lower() == self.name

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """All prims of splats as one scene, in memory."""
        with library_errors(path), stage_of(path, alone=True) as stage:
            prims = [prim for prim in stage.Traverse() if str(prim.GetTypeName()) == TYPE]
            if not prims:
                raise FormatError(path, f"holds no {TYPE}; is it a mesh?")
            parts = [_read(path, prim, str(module("UsdGeom").GetStageUpAxis(stage))) for prim in prims]
            said = stage.GetRootLayer().customLayerData.get(KEY)
            degree = max(part.sh_degree for part in parts)
            scene = joined([of_degree(part, degree) for part in parts])
        record = {} if said is None else {KEY: parse_json(str(said).encode(), path)}
        facts = read_record(path, record, Facts(EVIDENCE))
        return Scene(path, self.name, len(scene), degree, lambda start, stop: scene[start:stop], *facts)

    def write(
        self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions
    ) -> None:
        """Write a scene as one prim."""
        scene = half_turn_about_z(joined([holdable(path, part, self.name, MAX_DEGREE) for part in parts]))
        if not len(scene):
            raise OutputError(path, f"a .{self.name} cannot hold a scene without Gaussians; write a .ply")
        stage = _stage(scene)
        with replacing_file(path, overwrite, f".{self.name}") as temporary:
            if self.name != "usdz":
                done = stage.GetRootLayer().Export(str(temporary))
            else:
                with replacing_file(temporary.with_suffix(".usdc"), overwrite=True, suffix=".usdc") as inner:
                    stage.GetRootLayer().Export(str(inner))
                    done = module("UsdUtils").CreateNewUsdzPackage(str(inner), str(temporary))
            if not done:
                raise OutputError(path, "cannot be written: usd-core failed")


FORMATS = tuple(UsdFormat(suffix) for suffix in SUFFIXES)


def _read(path: Path, prim: Any, up: str) -> Gaussians:
    Usd, UsdGeom, place = module("Usd"), module("UsdGeom"), Place(path, f"prim {prim.GetPath()}")
    time = Usd.TimeCode.EarliestTime()  # the default where nothing moves

    def value(name: str) -> Any:
        attribute = prim.GetAttribute(name)
        return attribute.Get(time) if attribute else None

    def column(name: str) -> np.ndarray:
        found = value(name)
        found = value(f"{name}h") if found is None or not len(found) else found
        place.expect(found is not None, name, "an array", found)
        array = np.asarray(found, np.float32)
        fits = array.size % WIDTHS[name] == 0 and array.ndim <= 2
        place.expect(fits, name, f"rows of {WIDTHS[name]} numbers", array.shape)
        return array.reshape(-1, WIDTHS[name])

    means, quats, scales, opacities = (column(name) for name in list(WIDTHS)[:4])
    count, degree = len(means), value(DEGREE)
    check_count(path, count)
    right = isinstance(degree, int) and 0 <= degree <= MAX_DEGREE
    place.expect(right, DEGREE, f"a whole number from 0 to {MAX_DEGREE}", degree)
    sh, each = column(HARMONICS), (degree + 1) ** 2
    for name, rows, wanted in (
        ("orientations", quats, count),
        ("scales", scales, count),
        ("opacities", opacities, count),
        (HARMONICS, sh, count * each),
    ):
        place.expect(len(rows) == wanted, name, f"{wanted:,} values", len(rows))
    logits = logit_of(floats(opacities[:, 0]))
    turned = floats(quats).roll(1, dims=1)  # numpy's view has the real part last
    scene = Gaussians(floats(means), turned, floats(scales).log(), logits, floats(sh).reshape(count, each, 3))
    rows = [list(row) for row in UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time)]
    motion = torch.tensor(rows, dtype=torch.float64).T
    place.expect(bool(motion.isfinite().all()), "its transform", "finite", rows)
    return standing(scene, FROM_Z_UP @ motion if up == "Z" else motion, place)


def _stage(scene: Gaussians) -> Any:
    """A stage in memory with the scene, which is in its axes."""
    Usd, UsdGeom, Sdf, Vt = (module(name) for name in ("Usd", "UsdGeom", "Sdf", "Vt"))
    stage, types = Usd.Stage.CreateInMemory(), Sdf.ValueTypeNames
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim("/Splats", TYPE)
    stage.SetDefaultPrim(prim)
    stage.GetRootLayer().customLayerData = {KEY: json.dumps(record_of(scene))}
    reach = EXTENT_SIGMAS * scene.scales.amax(dim=1, keepdim=True)
    extent = torch.stack([(scene.means - reach).amin(dim=0), (scene.means + reach).amax(dim=0)])
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
