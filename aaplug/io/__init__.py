"""Files: scenes, cameras, images and videos are read and written here and nowhere else.

Every public function takes paths as `str | os.PathLike[str]`.  No file makes a reader run code, leave its data set's
folder, or allocate more than `limits` allows.
"""

from typing import Literal

MOST_FPS = 1000  # frames per second of a video

StreamName = Literal["sog", "3dtiles", "rad"]  # of `lod --to`
STREAM_INDEXES = {"sog": "lod-meta.json", "3dtiles": "tileset.json", "rad": "scene.rad"}  # files that viewers open
