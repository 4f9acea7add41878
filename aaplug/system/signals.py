"""Signals that ask a process to end, answered as Ctrl-C is: claims are given up and temporary files removed."""

import signal
import sys
from types import FrameType
from typing import NoReturn

CLOSED = getattr(signal, "SIGHUP", None)  # of a terminal that closes; Windows has none


def end_as_by_interrupt() -> None:
    """Answer TERM, of schedulers and containers, and HUP as SIGINT is answered.  For a program of our own."""
    for number in (signal.SIGTERM, CLOSED):
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:  # not where nohup ignores it
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if number == CLOSED:
        signal.signal(number, signal.SIG_IGN)  # it comes twice
    answer = signal.getsignal(signal.SIGINT)
    if not callable(answer):  # a shell ignores it for what runs in the background
        raise KeyboardInterrupt
    answer(signal.SIGINT, frame)


def end_as_worker() -> None:
    """Let TERM alone end this worker process, in order; its parent answers the rest."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if CLOSED is not None:
        signal.signal(CLOSED, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)


def _exit(number: int, frame: FrameType | None) -> NoReturn:
    sys.exit(128 + number)
