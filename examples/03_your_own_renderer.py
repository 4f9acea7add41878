"""Filter only: anti-aliased splats of a view, for a rasterizer of your own."""

from pathlib import Path

import aaplug

SAMPLE = Path(aaplug.__file__).parent / "io" / "sample"


def main(folder: Path) -> None:
    scene, cameras = aaplug.read_scene(SAMPLE / "chair.ply"), aaplug.read_cameras(SAMPLE)
    renderer = aaplug.Renderer.of(scene, cameras, "matched")
    splats = renderer.splats(cameras.test[0].scaled(1 / 4))
    print(f"{len(splats):,} splats; the first has the covariance {splats.covs[0].tolist()} px²")
    print(f"(xx, xy, yy) and opacity {splats.opacities[0]:.3f}")


if __name__ == "__main__":
    main(Path())
