"""Options of `view`."""

from dataclasses import dataclass
from typing import Annotated

from aaplug.options.base import flag, number
from aaplug.options.shared import ViewOptions


@dataclass(frozen=True, kw_only=True)
class LiveOptions(ViewOptions):
    """The page, and how the scene is drawn."""

    host: Annotated[str, flag("ADDRESS")] = "127.0.0.1"
    """Address to listen on; any but this machine's own asks for the token in the printed address."""
    port: Annotated[int, number(0, 65_535, whole=True)] = 8080
    """Port to listen on; 0 takes any free one."""
    no_browser: bool = False
    """Print the address, and open no browser."""
