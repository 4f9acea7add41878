"""Draw every picture of examples/guides: python -m tests.bench.pictures."""

from importlib.resources import as_file, files

from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene

from . import FOLDER
from .concepts import concepts
from .gallery import gallery
from .scales import scales


def main() -> None:
    """Write the figures and the gallery's images."""
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply"), read_cameras(sample)
        drawn = {f"{plot.name}.svg": plot.svg().encode() for plot in (*concepts(scene, cameras), scales())}
        drawn |= gallery(scene, cameras)
    for name, content in drawn.items():
        (FOLDER / name).write_bytes(content)
        print(f"{FOLDER.name}/{name}: {len(content):,} bytes")


if __name__ == "__main__":
    main()
