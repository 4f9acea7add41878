"""Random scenes in every format that is delivered, as the formats' own checkers and splat-transform see them.

GLTF_VALIDATOR names the folder of the npm package gltf-validator; SPLAT_TRANSFORM, or the path, the program.
"""

import json
import os
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from aaplug import Gaussians, read_scene, write_scene
from aaplug.core.conventions import CONVENTIONS
from aaplug.io.scenes.usd import module
from tests.bench import heading, row

SCRIPT = """
const fs = require("fs"), path = require("path"), validator = require(process.argv[1]);
(async () => {
  for (const file of fs.readFileSync(0, "utf8").split("\\n").filter(Boolean)) {
    const beside = (uri) => Promise.resolve(new Uint8Array(fs.readFileSync(path.join(path.dirname(file), uri))));
    const report = await validator.validateBytes(
      new Uint8Array(fs.readFileSync(file)),
      { uri: path.basename(file), maxIssues: 0, externalResourceFunction: beside });
    for (const { code, message, severity, pointer } of report.issues.messages)
      console.log(JSON.stringify({ file, code, message, severity, pointer }));
  }
})();
"""
WARNING = 1  # severities: 0 errors, 1 warnings, 2 information, 3 hints
USD_SCENES = 50
NAMES = "/attributes/KHR_gaussian_splatting:"  # of the ratified extension, which the validator does not know yet


def checked(files: Sequence[Path]) -> Counter[str]:
    """Errors and warnings of the Khronos validator, but for the names of the extension's attributes."""
    command = ["node", "-e", SCRIPT, os.environ["GLTF_VALIDATOR"]]
    text = "\n".join(str(file.resolve()) for file in files)
    run = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    found = Counter[str]()
    for issue in map(json.loads, run.stdout.splitlines()):
        unknown = issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and NAMES in issue["pointer"]
        if issue["severity"] <= WARNING and not unknown:
            found[f"{issue['code']}: {issue['message']}"] += 1
    return found


def checked_by_usd(files: Sequence[Path]) -> Counter[str]:
    """What all of USD's validators find wrong."""
    Usd, Validation = module("Usd"), module("UsdValidation")
    context = Validation.ValidationContext(Validation.ValidationRegistry().GetOrLoadAllValidators())
    return Counter(e.GetMessage() for file in files for e in context.Validate(Usd.Stage.Open(str(file))))


def random_scene(seed: int) -> Gaussians:
    """A scene of 1 to 300 Gaussians of any degree, size, place and convention."""
    draw = torch.Generator().manual_seed(seed)
    count, degree = int(torch.randint(1, 300, (), generator=draw)), seed % 4

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=draw)

    size = 10 ** (2 * normal(1)).clamp(-4, 4)
    return Gaussians(
        means=size * normal(count, 3),
        quats=normal(count, 4),
        log_scales=size.log() - 4 + normal(count, 3),
        logit_opacities=4 * normal(count),
        sh=0.3 * normal(count, (degree + 1) ** 2, 3),
        convention=list(CONVENTIONS.values())[seed % len(CONVENTIONS)],
    )


def main(scenes: int = 1000) -> None:
    """Validate so many random scenes as .glb, .gltf and .spz.glb and some as USD; read what splat-transform writes."""
    heading("validated", "format", "scenes", "errors and warnings")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for suffix in ("glb", "gltf", "spz.glb"):
            if "GLTF_VALIDATOR" in os.environ:
                files = [folder / f"{seed}.{suffix}" for seed in range(scenes)]
                for seed, file in enumerate(files):
                    write_scene(file, random_scene(seed))
                row(suffix, len(files), dict(checked(files)) or 0)
        for suffix in ("usda", "usdc", "usdz"):
            files = [folder / f"{seed}.{suffix}" for seed in range(USD_SCENES)]
            for seed, file in enumerate(files):
                write_scene(file, random_scene(seed))
            row(suffix, len(files), dict(checked_by_usd(files)) or 0)
        program = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
        if program:
            _exchange(folder, program)


def _exchange(folder: Path, program: str) -> None:
    """Largest differences: ours as it reads them, and theirs as we do."""
    columns = ("file", "whose", "Gaussians", "position, of the extent", "log-scale", "opacity", "harmonics")
    heading("splat-transform", *columns)
    scene = replace(random_scene(203), convention=CONVENTIONS["mip"])
    size = scene.means.std()
    scene = replace(scene, means=scene.means / size, log_scales=(scene.log_scales - size.log()).clamp(-9, 5))
    write_scene(folder / "scene.ply", scene)

    def transform(source: str, target: str) -> None:
        levels = (
            ["-l", "0"] if target.endswith("lod-meta.json") else ["-L", "0"] if source.endswith("lod-meta.json") else []
        )
        words = [program, "-q", "-w", "-g", "cpu", str(folder / source), *levels, str(folder / target)]
        subprocess.run(words, check=True, capture_output=True, timeout=300)

    for suffix in ("ply", "compressed.ply", "spz", "sog", "splat", "meta.json"):
        (folder / "ours").mkdir(exist_ok=True)
        ours = f"ours/{suffix}" if suffix == "meta.json" else f"ours/a.{suffix}"
        write_scene(folder / ours, scene, overwrite=True, spz_axes="opencv")
        transform(ours, "back.ply")
        _compare(ours, "ours", read_scene(folder / "back.ply").gaussians(), read_scene(folder / ours).gaussians())
    for suffix in ("ply", "compressed.ply", "spz", "sog", "meta.json", "lod-meta.json", "glb"):
        (folder / "theirs").mkdir(exist_ok=True)
        theirs = f"theirs/{suffix}" if suffix.endswith("meta.json") else f"theirs/a.{suffix}"
        transform("scene.ply", theirs)
        found = read_scene(folder / theirs, spz_axes="opencv").gaussians()
        if suffix == "glb":
            _compare(theirs, "theirs", found, scene)
            continue
        transform(theirs, "back.ply")
        _compare(theirs, "theirs", found, read_scene(folder / "back.ply").gaussians())


def _compare(file: str, whose: str, first: Gaussians, second: Gaussians) -> None:
    nearest = torch.cdist(first.means.double(), second.means.double()).argmin(dim=1)
    second, k = second[nearest], min(first.sh.shape[1], second.sh.shape[1])
    extent = float((second.means.amax(0) - second.means.amin(0)).max())
    errors = [
        float((first.means - second.means).abs().max()) / extent,
        float((first.log_scales - second.log_scales).abs().max()),
        float((first.opacities - second.opacities).abs().max()),
        float((first.sh[:, :k] - second.sh[:, :k]).abs().max()),
    ]
    row(file, whose, f"{len(first)} of {len(nearest.unique())}", *(f"{error:.1e}" for error in errors))
