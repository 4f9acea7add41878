"""A scene live in the browser."""

import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.resources import as_file, files
from pathlib import Path

from aaplug.methods import RECIPES
from aaplug.options.verbs import RECIPE_NAMES, LiveOptions
from aaplug.rendering.job import CamerasLike, Job, running
from aaplug.system.extras import check_installed
from aaplug.verbs.verb import SceneLike, looks

SAMPLE = "chair.ply"
WAIT_SECONDS = 3600.0  # at once, for the interrupt that ends a view


@looks(LiveOptions)
@contextmanager
def serving(scene: SceneLike | None, cameras: CamerasLike, options: LiveOptions) -> Iterator[str]:
    """A block in which a scene can be seen live in the browser; yields the page's address.

    Arguments and errors: see `view`.
    """
    check_installed("websockets", "view", "view", "needs the extra `view`")
    from aaplug.live.server import Server  # its package is an extra
    from aaplug.live.subject import Subject

    def subject_of(scene: SceneLike, cameras: CamerasLike, title: str | None, words: Sequence[str]) -> Subject:
        job = Job.of(scene, cameras, options)
        look = job.look(None, check=False)
        job.say_assumed()
        recipes = [name for name in RECIPE_NAMES if name in RECIPES]  # without plug-ins that cannot be used
        title = title or job.scene.title
        return Subject(job.cameras, look, recipes, title, words or (str(job.scene.file or title),))

    def dropped(path: Path) -> Subject:
        return subject_of(path, None, path.name, (path.name,))

    with ExitStack() as stack:
        stack.enter_context(running(options))
        title = None
        if scene is None:
            folder = stack.enter_context(as_file(files("aaplug.io.sample")))
            scene, cameras, title = folder / SAMPLE, folder if cameras is None else cameras, "the bundled sample"
        subject = subject_of(scene, cameras, title, options.words)
        yield stack.enter_context(Server(subject, dropped, options.host, options.port)).address


@looks(LiveOptions)
def view(scene: SceneLike | None, cameras: CamerasLike, options: LiveOptions) -> None:
    """Show a scene live in the browser, until interrupted.

    Args:
        scene: see `render`; None for the bundled sample.
        cameras: see `render`.

    Raises:
        AaplugError: an input cannot be read, an option does not fit, or nothing can listen at the address.
    """
    say = options.monitor.say
    with serving(scene, cameras, **vars(options)) as address:
        say(f"open {address} in a browser; Ctrl-C ends")
        if not options.no_browser:
            with suppress(webbrowser.Error):
                browser = webbrowser.get()
                if type(browser) is not webbrowser.GenericBrowser:  # that runs in the terminal, and would take it over
                    browser.open(address)
        try:
            while True:
                time.sleep(WAIT_SECONDS)  # Windows hears no Ctrl-C in the wait for an event
        except KeyboardInterrupt:  # the usual end
            say("closed")
