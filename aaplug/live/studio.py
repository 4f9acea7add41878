"""The studio: one thread that draws for all pages in turn, a step for each that wants one."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from aaplug.core.errors import AaplugError, UsageError, printable
from aaplug.live.messages import See, Shown, Still
from aaplug.live.pictures import Pictures, Steps, message
from aaplug.live.subject import Subject

IN_FLIGHT = 2  # pictures that are sent and not yet shown, so that a slow line delays no newer one
MOST_STILLS = 4  # that wait; more are refused

log = logging.getLogger("aaplug")


@dataclass(eq=False)
class Page:
    """One client: what it wants, and the steps that lead there.

    send: called from the studio's thread with a message.
    """

    pictures: Pictures
    send: Callable[[bytes], object]
    see: See | None = None
    newer: bool = False
    steps: Steps | None = None
    stills: deque[Still] = field(default_factory=deque)
    sent: int = 0
    shown: int = 0

    @property
    def busy(self) -> bool:
        """Whether there is a step to take now."""
        return self.sent - self.shown < IN_FLIGHT and bool(self.newer or self.steps or self.stills)

    def step(self) -> bytes | None:
        """Take one step; newer wishes replace what is being drawn."""
        assert self.see is not None
        if self.newer or self.steps is None:
            if self.steps is not None:
                self.steps.close()
            if self.newer:
                self.newer, self.steps = False, self.pictures.steps(self.see)
            else:
                self.steps = self.pictures.still(self.see, self.stills.popleft())
        try:
            return next(self.steps)
        except StopIteration:
            self.steps = None
            return None


class Studio:
    """Draws for all pages; a context, in which its thread runs."""

    def __init__(self, subject: Subject):
        self.subject = subject
        self._pages: deque[Page] = deque()  # the next one in turn stands first
        self._changed = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)

    def __enter__(self) -> "Studio":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._open = False
            self._changed.notify()
        self._thread.join()

    def enter(self, send: Callable[[bytes], object]) -> Page:
        """Begin to draw for a page."""
        page = Page(Pictures(self.subject), send)
        with self._changed:
            self._pages.append(page)
        return page

    def leave(self, page: Page) -> None:
        """Stop drawing for a page."""
        with self._changed:
            self._pages.remove(page)

    def tell(self, page: Page, said: See | Still | Shown) -> None:
        """Receive what a page wants.

        Raises:
            UsageError: it wants more than it may.
        """
        with self._changed:
            match said:
                case See():
                    page.see, page.newer = said, True
                case Still() if page.see is None or len(page.stills) >= MOST_STILLS:
                    raise UsageError("still", "wait until the ones before are done")
                case Still():
                    page.stills.append(said)
                case Shown():
                    page.shown = min(page.sent, page.shown + 1)
            self._changed.notify()

    def _run(self) -> None:
        while (page := self._next()) is not None:
            try:
                found = page.step()
            except Exception as error:  # one picture fails, the studio goes on
                page.steps = None
                known = isinstance(error, AaplugError | MemoryError)
                if not known:
                    log.warning("a picture failed: %r", error)
                found = message({"problem": printable(str(error) or "out of memory")}, [])
            if found is not None:
                page.sent += 1
                page.send(found)

    def _next(self) -> Page | None:
        """The page whose turn it is, once there is one; None at the end."""
        with self._changed:
            while self._open:
                for _ in range(len(self._pages)):
                    page = self._pages[0]
                    self._pages.rotate(-1)
                    if page.busy:
                        return page
                self._changed.wait()
        return None
