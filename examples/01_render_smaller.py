"""Render a classic checkpoint at a quarter of its training size, as it would look if training's image were averaged."""

from pathlib import Path

import aaplug

SAMPLE = Path(aaplug.__file__).parent / "sample"


def main(folder: Path) -> None:
    scene = aaplug.read_scene(SAMPLE / "chair.ply")
    cameras = aaplug.read_cameras(SAMPLE)
    training = aaplug.learn(scene, cameras.train)

    view = cameras.test[0].scaled(1 / 4)
    for name in ("classic", "auto"):
        recipe = aaplug.find_recipe(name)
        image = aaplug.render(scene, view, recipe, training, background=(1.0, 1.0, 1.0))
        aaplug.write_png(folder / f"{name}.png", image.rgb, overwrite=True)
        print(f"wrote {folder / name}.png")


if __name__ == "__main__":
    main(Path())
