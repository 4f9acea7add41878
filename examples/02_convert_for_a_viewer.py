"""Fuse anti-aliasing into a plain .ply, for a viewer with the 2D Mip filter."""

from pathlib import Path

import aaplug

SAMPLE = Path(aaplug.__file__).parent / "sample"


def main(folder: Path) -> None:
    scene = aaplug.read_scene(SAMPLE / "chair.ply")
    training = aaplug.learn(scene, aaplug.read_cameras(SAMPLE).train)

    converted = aaplug.convert(scene, training, aaplug.FORMS["matched-energy"])
    aaplug.write_scene(folder / "chair-converted.ply", converted, overwrite=True)
    print(f"fused {converted.fused[0]}; the file says {converted.convention.name}")


if __name__ == "__main__":
    main(Path())
