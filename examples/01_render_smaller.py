"""Render a classic checkpoint at a quarter of its training size, aliased and anti-aliased."""

from pathlib import Path

import aaplug

SAMPLE = Path(aaplug.__file__).parent / "io" / "sample"


def main(folder: Path) -> None:
    scene, cameras = aaplug.read_scene(SAMPLE / "chair.ply"), aaplug.read_cameras(SAMPLE)
    view = cameras.test[0].scaled(1 / 4)
    for recipe in ("classic", "auto"):
        renderer = aaplug.Renderer.of(scene, cameras, recipe)
        aaplug.write_png(folder / f"{recipe}.png", renderer(view).rgb, overwrite=True)
        print(f"wrote {folder / recipe}.png")


if __name__ == "__main__":
    main(Path())
