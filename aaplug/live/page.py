"""One page: what it wants to see, and the steps that lead there."""

import asyncio
import logging
from collections import deque
from dataclasses import dataclass, field

from aaplug.live.messages import Order, PictureRequest
from aaplug.live.pictures import Pictures, Steps, message
from aaplug.live.subject import Subject
from aaplug.system.errors import AaplugError, UsageError, printable

MAX_IN_FLIGHT = 2  # pictures that are sent and have not arrived, so that a slow line delays no newer one
MAX_WAITING_ORDERS = 4  # more are refused

log = logging.getLogger("aaplug")


@dataclass(eq=False)
class Page:
    """A page that shows a subject; one thread takes its steps, another receives its messages.

    newer: True if no step for the request is taken yet.  changed: set when it wants something else.
    sent, received: counts of pictures.
    """

    subject: Subject
    request: PictureRequest | None = None
    newer: bool = False
    steps: Steps | None = None
    orders: deque[Order] = field(default_factory=deque)
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    sent: int = 0
    received: int = 0

    def __post_init__(self) -> None:
        self.pictures = Pictures(self.subject)

    def receive(self, said: PictureRequest | Order | None) -> None:
        """Take a message of the page, as `parse` gives it; raises UsageError if it wants more than it may."""
        match said:
            case PictureRequest():
                self.request, self.newer = said, True
            case None:
                self.received = min(self.sent, self.received + 1)
            case _ if self.request is None or len(self.orders) >= MAX_WAITING_ORDERS:
                raise UsageError("still", "wait until the ones before are done")
            case _:
                self.orders.append(said)
        self.changed.set()

    @property
    def busy(self) -> bool:
        """True if there is a step to take now."""
        return self.sent - self.received < MAX_IN_FLIGHT and bool(self.newer or self.steps or self.orders)

    def step(self) -> bytes | None:
        """Take one step, and return what it has to send; a newer request replaces what is being drawn."""
        assert self.request is not None
        try:
            if self.newer:
                self.newer = False  # before the request is read: the next one may come at any time
                self.steps = self.pictures.steps(self.request)
            elif self.steps is None:
                self.steps = self.pictures.ordered(self.request, self.orders.popleft())
            return next(self.steps)
        except StopIteration:
            self.steps = None
            return None
        except Exception as error:  # one picture fails, the page goes on
            self.steps = None
            if not isinstance(error, AaplugError | MemoryError):
                log.warning("a picture failed: %r", error)
            return message({"problem": printable(str(error) or "out of memory")}, [])
