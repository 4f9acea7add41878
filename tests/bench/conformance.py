"""Web viewers and splat-transform by the kit of `aaplug conform`: tests that are right, and what is wrong in others.

It needs Node.js, npm and Chromium.  No rule is stated: the one that fits best is found, and printed.  splat-transform
draws by WebGPU and needs Node.js 22; Vulkan's loader (libvulkan1) and VK_ICD_FILENAMES with the path of Chromium's
vk_swiftshader_icd.json serve it where there is no graphics card.
"""

import math
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from PIL import Image

import aaplug
from aaplug import read_cameras, read_scene, write_png
from tests.bench import heading, row
from tests.bench.viewers import FOLDER, OPENGL, PAGES, Page

SPLAT_TRANSFORM = "splat-transform"
PROGRAM = FOLDER / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"


def main(
    work: Path = Path("out/conformance"), rows: Sequence[str] = (*PAGES, SPLAT_TRANSFORM), node: str = "node"
) -> None:
    """Print the table.

    Args:
        work: folder of scenes and pictures.
        rows: of `aaplug viewers`, that a page here can show, and splat-transform.
        node: Node.js of version 22 or later, for splat-transform.
    """
    heading("conformance", "shown as", "found", "right", "wrong")
    for name in rows:
        program = _render(node) if name == SPLAT_TRANSFORM else _page(PAGES[name], work / "page")
        verdict = aaplug.conform(program, output=work / name, overwrite=True)
        assert verdict is not None
        wrong = [f"`{f.test}` ({f.error or math.nan:.0f}): {f.wrong}" for f in verdict.findings if f.wrong]
        count = len(verdict.findings)
        row(f"`{name}`", f"`{verdict.viewer.name}`", f"{count - len(wrong)} of {count}", "; ".join(wrong))


def _page(page: Page, shown: Path) -> Callable[[Path, Path, Path], None]:
    """A page as a program."""

    def program(scene: Path, camera: Path, image: Path) -> None:
        [view] = read_cameras(camera).train
        write_png(image, page.shot(read_scene(scene).gaussians(), shown, {0: view}, shown)[0])

    return program


def _render(node: str) -> Callable[[Path, Path, Path], None]:
    """splat-transform's rasterizer as a program; its world is the file's, turned by half a turn around z."""

    def program(scene: Path, camera: Path, image: Path) -> None:
        [view] = read_cameras(camera).train
        turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
        pose = turned @ torch.linalg.inv(view.cam_from_world.double()) @ OPENGL
        eye, picture = pose[:3, 3], image.with_suffix(".webp")
        places = {"pos": eye, "target": eye - pose[:3, 2], "up": pose[:3, 1]}
        words = [f"--camera-{key}={','.join(f'{x:.9g}' for x in place)}" for key, place in places.items()]
        words += [f"--camera-fov={math.degrees(2 * math.atan(view.height / 2 / view.fy))}"]
        words += ["--resolution", f"{view.width}x{view.height}"]
        subprocess.run([node, str(PROGRAM), "-q", "-w", "-g", "0", str(scene), str(picture), *words], check=True)
        with Image.open(picture) as drawn:
            drawn.convert("RGB").save(image)

    return program
