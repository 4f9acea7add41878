"""The studio: one thread that draws for all pages in turn, a step for each that wants one."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from aaplug.live.messages import Order, PictureRequest, Receipt
from aaplug.live.pictures import Pictures, Steps, message
from aaplug.live.subject import Subject
from aaplug.system.errors import AaplugError, UsageError, printable

MAX_IN_FLIGHT = 2  # pictures that are sent and have not arrived, so that a slow line delays no newer one
MAX_WAITING_ORDERS = 4  # more are refused

log = logging.getLogger("aaplug")


@dataclass(eq=False)
class Page:
    """One client: what it wants, and the steps that lead there.

    send: called from the studio's thread with a message.  newer: True if no step for the request is taken yet.
    sent, received: counts of pictures.
    """

    pictures: Pictures
    send: Callable[[bytes], object]
    request: PictureRequest | None = None
    newer: bool = False
    steps: Steps | None = None
    orders: deque[Order] = field(default_factory=deque)
    sent: int = 0
    received: int = 0

    @property
    def busy(self) -> bool:
        """True if there is a step to take now."""
        return self.sent - self.received < MAX_IN_FLIGHT and bool(self.newer or self.steps or self.orders)

    def step(self) -> bytes | None:
        """Take one step; a newer request replaces what is being drawn."""
        assert self.request is not None
        if self.newer:
            self.newer = False  # before the request is read: the next one may come at any time
            self.steps = self.pictures.steps(self.request)
        elif self.steps is None:
            self.steps = self.pictures.ordered(self.request, self.orders.popleft())
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

    @contextmanager
    def page(self, send: Callable[[bytes], object]) -> Iterator[Page]:
        """A block in which the studio draws for a page; `send`: see `Page`."""
        page = Page(Pictures(self.subject), send)
        with self._changed:
            self._pages.append(page)
        try:
            yield page
        finally:
            with self._changed:
                self._pages.remove(page)

    def show(self, page: Page, subject: Subject) -> None:
        """Draw another subject for a page from now on."""
        with self._changed:
            page.pictures, page.request, page.newer, page.steps = Pictures(subject), None, False, None
            page.orders.clear()

    def receive(self, page: Page, said: PictureRequest | Order | Receipt) -> None:
        """Take a message of a page; raises UsageError if it wants more than it may."""
        with self._changed:
            match said:
                case PictureRequest():
                    page.request, page.newer = said, True
                case Receipt():
                    page.received = min(page.sent, page.received + 1)
                case _ if page.request is None or len(page.orders) >= MAX_WAITING_ORDERS:
                    raise UsageError("still", "wait until the ones before are done")
                case _:
                    page.orders.append(said)
            self._changed.notify()

    def _run(self) -> None:
        while (page := self._next()) is not None:
            try:
                picture = page.step()
            except Exception as error:  # one picture fails, the studio goes on
                page.steps = None
                if not isinstance(error, AaplugError | MemoryError):
                    log.warning("a picture failed: %r", error)
                picture = message({"problem": printable(str(error) or "out of memory")}, [])
            if picture is not None:
                page.sent += 1
                page.send(picture)

    def _next(self) -> Page | None:
        """The page whose turn it is, once there is one; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: not self._open or any(page.busy for page in self._pages))
            while self._open:
                page = self._pages[0]
                self._pages.rotate(-1)
                if page.busy:
                    return page
        return None
