"""Whether bounds per direction beat isotropic ones: python -m tests.bench.anisotropic [SCENE ...].

Checkpoints trained at a small size are enlarged and compared with their photographs, and seen from nearer and compared
with the checkpoint trained at full size.  Candidates: training's dilation fused in the world as 0.3/ν², isotropic, and
per axis by the views' information at the same volume; and both forms of Mip-Splatting's 3D filter.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace

from torch import Tensor

from aaplug.core.camera_paths import moved
from aaplug.core.cameras import Camera
from aaplug.core.gaussians import CLASSIC, Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.protocols import median_depth
from aaplug.io.cameras import read_cameras
from aaplug.io.photographs import DOWNSCALES
from aaplug.io.scenes import read_scene
from aaplug.methods.filters import NYQUIST_VARIANCE, AnisotropicSmoothing, Dilation, Smoothing3D
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.renderer import Renderer
from tests.bench.away import MATCHED, VIEWS, Scene, decibels, look_there, on_each
from tests.conftest import SHARED_DATA

TRAINED_SMALL = ("chair_eighth", "snowmiku_quarter")
ENLARGED = (2, 4, 8)
NEARER = (2.0, 1.4)
AS_IT_IS = Recipe("fused", Dilation(0.0, compensated=False), "", "")


def compared(scene: Gaussians, training: TrainingViews) -> dict[str, tuple[Gaussians, Recipe]]:
    """Filtered scenes and their recipes."""
    look_of_training = Smoothing3D(CLASSIC.kernel, opacity="kept")(scene, training)
    own = AnisotropicSmoothing(CLASSIC.kernel)(scene, training)
    added = [s.scales.square() - scene.scales.square() for s in (look_of_training, own)]
    scale = (added[0].log() - added[1].log()).mean(dim=1, keepdim=True).exp()
    same_volume = (scene.scales.square() + scale * added[1]).log() / 2
    mip = find_recipe("mip")
    return {
        "`matched`": (scene, find_recipe("matched")),
        "fused, isotropic": (look_of_training, AS_IT_IS),
        "fused, anisotropic, same volume": (replace(scene, log_scales=same_volume), AS_IT_IS),
        "`mip-splatting`": (Smoothing3D(NYQUIST_VARIANCE)(scene, training), mip),
        "`mip-splatting-anisotropic`": (AnisotropicSmoothing()(scene, training), mip),
    }


def main(names: Sequence[str] = TRAINED_SMALL) -> None:
    on_each(names or TRAINED_SMALL, measure)


def measure(name: str, how: Scene, rasterizer: Rasterizer) -> None:
    """Print a table of PSNR in dB, mean of the views."""
    cameras = read_cameras((SHARED_DATA / how.file).parent, train_scale=how.scale)
    scene = read_scene(SHARED_DATA / how.file)
    training = TrainingViews.of(scene, cameras, how.cull_margin)
    views = cameras.test[:: -(-len(cameras.test) // VIEWS)]
    chosen = compared(scene, training)
    print(f"\n{name}, PSNR in dB\n\n| | " + " | ".join(chosen) + " |")
    print("|---" * (len(chosen) + 1) + "|")
    for label, shown in cases(scene, views, how, rasterizer):
        cells = []
        for filtered, recipe in chosen.values():
            renderer = Renderer(filtered, training, recipe, rasterizer, how.background)
            found = [decibels(renderer(camera).rgb, truth) for camera, truth in shown]
            cells.append(f"{sum(found) / len(found):.2f}")
        print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


def cases(
    scene: Gaussians, views: Sequence[Camera], how: Scene, rasterizer: Rasterizer
) -> Iterator[tuple[str, list[tuple[Camera, Tensor]]]]:
    """Cameras, each with what it should show."""
    for factor in ENLARGED:
        if factor * how.scale <= 1:
            shown = []
            for view in views:
                assert view.photo is not None
                photo = DOWNSCALES["box"].read(view.photo, how.background, view.lens)
                camera = view.scaled(factor)
                shown.append((camera, photo.at(camera.hw, camera.width / photo.hw[1])))
            yield f"photographs at {factor}×", shown
    assert how.finer is not None
    full, folder = read_scene(SHARED_DATA / how.finer), (SHARED_DATA / how.file).parent
    training = TrainingViews.of(full, read_cameras(folder, train_scale=1.0), how.cull_margin)
    finer = Renderer(full, training, MATCHED, rasterizer, how.background)
    for factor in NEARER:
        near = [moved(view, factor, median_depth(scene.means, view)) for view in views]
        shown = [(camera, look_there(finer, camera)) for camera in near]
        yield f"{factor:g} times nearer, finer", shown


if __name__ == "__main__":
    main(sys.argv[1:])
