"""The server: one page over HTTP, one websocket for each open page, and nothing else.

Bound to this machine alone it asks for no secret, but refuses other names of the host, under which another page could
reach it (DNS rebinding).  Bound to a network it asks for the token that is in its address.  A websocket must come from
the server's own page.
"""

import asyncio
import hmac
import json
import logging
import secrets
import threading
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address
from os import strerror
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import Server as Listener
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from aaplug.core.errors import UsageError, reason
from aaplug.live.messages import MOST_BYTES, parsed
from aaplug.live.pictures import message
from aaplug.live.studio import Page, Studio
from aaplug.live.webpage import page

LIVE = "/live"  # the path of the websocket
MOST_PAGES = 32  # open at once
LOCAL = ("localhost", "127.0.0.1", "::1")
SILENT = logging.getLogger("aaplug.live")  # websockets would print a traceback for each bad request
SILENT.addHandler(logging.NullHandler())
SILENT.propagate = False


class Server:
    """Serves a studio's pages; a context, in which it listens.  port 0 takes any free one.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(self, studio: Studio, host: str = "127.0.0.1", port: int = 8080):
        self._studio, self._host, self._port = studio, host, port
        self._token = None if _is_local(host) else secrets.token_urlsafe(16)
        self._loop = asyncio.new_event_loop()
        self._started: threading.Event = threading.Event()
        self._trouble: OSError | None = None
        self._listener: Listener | None = None
        self._ends: asyncio.Event = asyncio.Event()
        self._open = 0
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        shown = f"[{self._host}]" if ":" in self._host else self._host
        token = "" if self._token is None else f"?token={self._token}"
        return f"http://{shown}:{self._port}/{token}"

    def __enter__(self) -> "Server":
        self._thread.start()
        self._started.wait()
        if self._trouble is not None:
            self._thread.join()
            raise UsageError("port", f"{self._port} of {self._host} cannot be used: {_why(self._trouble)}")
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._ends.set)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        how = {"max_size": MOST_BYTES, "max_queue": 16, "compression": None, "logger": SILENT, "server_header": None}
        try:
            listening = await serve(self._talk, self._host, self._port, process_request=self._answer, **how)
        except OSError as error:
            self._trouble = error
            self._started.set()
            return
        async with listening as listener:
            self._port = listener.sockets[0].getsockname()[1]
            self._started.set()
            await self._ends.wait()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or None to go on to a websocket."""
        parts = urlsplit(request.path)
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        host = hosts[0] if len(hosts) == 1 else ""
        if self._token is None and _name_of(host) not in (*LOCAL, self._host):
            return _said(HTTPStatus.FORBIDDEN, "This server answers to its own name alone.")
        token = parse_qs(parts.query).get("token", [""])[0]
        if self._token is not None and not hmac.compare_digest(token.encode(), self._token.encode()):
            return _said(HTTPStatus.FORBIDDEN, "Open the address that the terminal shows: it ends in a token.")
        if parts.path == "/":
            return _response(HTTPStatus.OK, "text/html", page().encode())
        if parts.path != LIVE:
            return _said(HTTPStatus.NOT_FOUND, "There is one page here: /")
        if len(origins) != 1 or origins[0] not in (f"http://{host}", f"https://{host}"):
            return _said(HTTPStatus.FORBIDDEN, "A websocket must come from this server's own page.")
        if self._open >= MOST_PAGES:
            return _said(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_PAGES} pages are open; close one.")
        return None

    async def _talk(self, connection: ServerConnection) -> None:
        """One page, from its first word to its last."""
        waiting: asyncio.Queue[bytes] = asyncio.Queue()  # the studio puts no more than a few
        guest = self._studio.enter(partial(self._hand, waiting))
        self._open += 1
        sending = None
        try:
            await connection.send(json.dumps(self._studio.subject.about(), allow_nan=False))
            sending = asyncio.create_task(_send_all(connection, waiting))
            await self._listen(connection, guest)
        except ConnectionClosed:
            pass  # a closed tab
        finally:
            self._open -= 1
            self._studio.leave(guest)
            if sending is not None:
                sending.cancel()

    def _hand(self, waiting: "asyncio.Queue[bytes]", said: bytes) -> None:
        """From the studio's thread to the page."""
        with suppress(RuntimeError):  # the server has closed meanwhile
            self._loop.call_soon_threadsafe(waiting.put_nowait, said)

    async def _listen(self, connection: ServerConnection, guest: Page) -> None:
        subject = self._studio.subject
        async for text in connection:
            try:
                self._studio.tell(guest, parsed(text, subject.recipes, len(subject.views)))
            except UsageError as error:
                await connection.send(message({"problem": str(error)}, []))


async def _send_all(connection: ServerConnection, waiting: "asyncio.Queue[bytes]") -> None:
    with suppress(ConnectionClosed):
        while True:
            await connection.send(await waiting.get())


def _why(error: OSError) -> str:
    """The system's own words; asyncio's name the address once more."""
    return (strerror(error.errno) if error.errno and error.errno > 0 else reason(error)).lower()


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _name_of(host: str) -> str:
    """The name in a Host header, without its port."""
    return host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]


def _said(status: HTTPStatus, text: str) -> Response:
    return _response(status, "text/plain", f"{text}\n".encode())


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers()
    headers["Content-Type"] = f"{kind}; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Content-Security-Policy"] = "frame-ancestors 'none'"
    for name, value in (("Cache-Control", "no-store"), ("X-Content-Type-Options", "nosniff")):
        headers[name] = value
    headers["Referrer-Policy"] = "no-referrer"
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
