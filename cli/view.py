"""aaplug view: a scene live in the browser."""

from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import aaplug
from aaplug.options.view import LiveOptions

from .console import TERMINAL, say
from .options import CameraOptions, Flat, SceneOptions


@dataclass(frozen=True)
class View:
    """Look at a scene live in the browser, classic 3DGS beside aaplug; without SCENE at the bundled sample."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[LiveOptions, Flat] = field(default_factory=LiveOptions)

    def __call__(self) -> int:
        """Serve the page until interrupted."""
        scene = cameras = None
        if self.scene.scene is not None or self.scene.model_path is not None:
            scene, cameras = self.scene.open(), self.cameras.read(self.scene.path)
        words = [*_words(self.scene), *_words(self.cameras), *_words(self.cameras.orbit)]
        own: dict[str, Any] = {"drop_bad": self.scene.drop_bad, "words": words} | vars(self.how)
        from aaplug.verbs.view import attend

        with aaplug.serving(scene, cameras, monitor=TERMINAL, **own) as address:
            try:
                attend(address, TERMINAL, self.how.no_browser)
            except KeyboardInterrupt:  # the usual end
                say("closed")
        return 0


def _words(options: Any) -> list[str]:
    """The command line's words that give these options."""
    found: list[str] = []
    for each in sorted(fields(options), key=lambda each: each.name != "scene"):  # the positional one first
        value = getattr(options, each.name)
        if value in (None, False) or value == each.default or (each.name == "orbit" and not isinstance(value, int)):
            continue
        flag = [] if each.name == "scene" else [f"--{each.name.replace('_', '-')}"]
        values = value if isinstance(value, list | tuple) else [] if value is True else [value]
        found += [*flag, *map(str, values)]
    return found
