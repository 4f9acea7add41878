"""Fuse anti-aliasing into a plain .ply, for a viewer with the 2D Mip filter."""

from pathlib import Path

import aaplug

SAMPLE = Path(aaplug.__file__).parent / "io" / "sample"


def main(folder: Path) -> None:
    output = folder / "chair-converted.ply"
    aaplug.convert(SAMPLE / "chair.ply", SAMPLE, output, overwrite=True)
    converted = aaplug.read_scene(output)
    print(f"fused {converted.fused[0]}; trained as the file says: {converted.convention.name}")


if __name__ == "__main__":
    main(Path())
