"""A scene live in the browser, classic 3DGS beside aaplug."""

import threading
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from aaplug.core.errors import UsageError
from aaplug.core.monitor import SILENT, Monitor
from aaplug.io.scenes import called
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.recipes import RECIPES
from aaplug.options.shared import RECIPE_NAMES
from aaplug.options.view import LiveOptions
from aaplug.verbs.assumed import say_assumed
from aaplug.verbs.inputs import CamerasLike, SceneLike, file_of, opened_and_seen, processor, shown_of, unchecked_look_of

FRAMES = 100  # that are drawn at least; not so many that kernels are compiled first
SAMPLE = "chair.ply"


@contextmanager
def serving(
    scene: SceneLike | SceneFile | None = None,
    cameras: CamerasLike = None,
    *,
    words: Sequence[str] = (),
    monitor: Monitor = SILENT,
    drop_bad: bool = False,
    **options: Any,
) -> Iterator[str]:
    """A block in which a scene can be seen live in the browser; yields the page's address.

    words: of a command line that name the scene and its cameras, for the page to show.
    Other arguments and errors: see `view`.
    """
    o = LiveOptions.of(options)
    if find_spec("websockets") is None:
        raise UsageError("view", "needs the extra `view`: pip install 'aaplug[view]'")
    from aaplug.live.server import Server  # its package is an extra
    from aaplug.live.studio import Studio
    from aaplug.live.subject import Subject

    with _sample_or(scene) as (shown, where), processor(o.threads):
        opened, cameras = opened_and_seen(shown, where if cameras is None else cameras, monitor)
        held = shown_of(opened, drop_bad)
        look = unchecked_look_of(held, cameras, FRAMES, o, monitor)
        say_assumed(cameras, monitor)
        file = file_of(opened)
        title = "the bundled sample" if scene is None else "scene" if file is None else called(file)
        recipes = [name for name in RECIPE_NAMES if name in RECIPES]  # without plug-ins that cannot be used
        subject = Subject(held, cameras, look, recipes, title, words or (str(file or title),))
        with Studio(subject) as studio, Server(studio, o.host, o.port) as server:
            yield server.address


@LiveOptions.shown
def view(
    scene: SceneLike | SceneFile | None = None,
    cameras: CamerasLike = None,
    *,
    drop_bad: bool = False,
    monitor: Monitor = SILENT,
    **options: Any,
) -> None:
    """Show a scene live in the browser, until interrupted.

    Args:
        scene: see `render`; None for the bundled sample.
        cameras: see `render`.
        drop_bad: leave out Gaussians of a file that cannot be used.
        monitor: receives messages.
        options: fields of `LiveOptions`.

    Raises:
        AaplugError: an input cannot be read, an option does not fit, or nothing can listen at the address.
    """
    with serving(scene, cameras, drop_bad=drop_bad, monitor=monitor, **options) as address:
        attend(address, monitor, LiveOptions.of(options).no_browser)


def attend(address: str, monitor: Monitor, no_browser: bool) -> None:
    """Open the page and wait for an interruption.  A browser that runs in the terminal would take it over."""
    monitor.say(f"open {address} in a browser; Ctrl-C ends")
    if not no_browser:
        with suppress(webbrowser.Error):
            browser = webbrowser.get()
            if type(browser) is not webbrowser.GenericBrowser:
                browser.open(address)
    threading.Event().wait()


@contextmanager
def _sample_or(scene: SceneLike | SceneFile | None) -> Iterator[tuple[SceneLike | SceneFile, Path | None]]:
    """The scene, or without one the bundled sample and its cameras."""
    if scene is not None:
        yield scene, None
        return
    with as_file(files("aaplug.io.sample")) as folder:
        yield folder / SAMPLE, folder
