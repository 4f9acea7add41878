"""Use the filters alone: new covariances and opacities for a renderer of your own."""

from pathlib import Path

import aaplug
from aaplug.core.projection import project
from aaplug.methods.filters import Matched

SAMPLE = Path(aaplug.__file__).parent / "sample"


def main(folder: Path) -> None:
    scene = aaplug.read_scene(SAMPLE / "chair.ply")
    cameras = aaplug.read_cameras(SAMPLE)
    training = aaplug.learn(scene, cameras.train)

    view = cameras.test[0].scaled(1 / 4)
    splats = Matched()(project(scene, view), view, training)
    print(f"{len(splats):,} splats; the first covers {splats.covs[0].tolist()} px² (xx, xy, yy)")
    print(f"and is drawn with opacity {splats.opacities[0]:.3f}")


if __name__ == "__main__":
    main(Path())
