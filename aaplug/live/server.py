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
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address
from os import strerror
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from aaplug.live.messages import MAX_MESSAGE_BYTES, parse
from aaplug.live.pictures import message
from aaplug.live.studio import Studio
from aaplug.live.webpage import page
from aaplug.system.errors import UsageError, reason

WEBSOCKET_PATH = "/live"
MAX_OPEN_PAGES = 32
MAX_WAITING_MESSAGES = 16  # to a page; one that reads leaves no more than two
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
log = logging.getLogger("aaplug.live")
log.addHandler(logging.NullHandler())
log.propagate = False  # websockets would print a traceback for each bad request


class Server:
    """Serves a studio's pages; a context, in which it listens.  port 0 takes any free one.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(self, studio: Studio, host: str = "127.0.0.1", port: int = 8080):
        self._studio, self._host, self._port = studio, host, port
        self._token = None if _is_local(host) else secrets.token_urlsafe(16)
        self._open_pages = 0
        self._started: Future[tuple[asyncio.AbstractEventLoop, int]] = Future()  # with its loop and port
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="server", daemon=True)

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        token = "" if self._token is None else f"?token={self._token}"
        return f"http://{host}:{self._port}/{token}"

    def __enter__(self) -> "Server":
        self._about = json.dumps(self._studio.subject.about(), allow_nan=False)
        self._thread.start()
        try:
            self._loop, self._port = self._started.result()
        except (OSError, UnicodeError) as error:
            self._thread.join()
            code = error.errno if isinstance(error, OSError) else None  # asyncio's own words name the address once more
            why = strerror(code).lower() if code and code > 0 else reason(error)
            raise UsageError("port", f"{self._port} of {self._host} cannot be used: {why}") from error
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    async def _serve(self) -> None:
        limits = {"max_size": MAX_MESSAGE_BYTES, "max_queue": 16, "compression": None}
        options = limits | {"process_request": self._answer, "logger": log, "server_header": None}
        try:
            listener = await serve(self._talk, self._host, self._port, **options)
        except (OSError, UnicodeError) as error:  # the latter: no host can have this name
            self._started.set_exception(error)
            return
        async with listener:
            self._started.set_result((asyncio.get_running_loop(), listener.sockets[0].getsockname()[1]))
            await self._end.wait()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, a refusal, or None to go on to a websocket."""
        path, _, query = request.path.partition("?")
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        host = hosts[0].casefold() if len(hosts) == 1 else ""
        name = host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]  # without its port
        if self._token is None and name not in (*LOCAL_NAMES, self._host.casefold()):
            return _response(HTTPStatus.FORBIDDEN, "This server answers to its own name alone.")
        token = parse_qs(query).get("token", [""])[0]
        if self._token is not None and not hmac.compare_digest(token.encode(), self._token.encode()):
            return _response(HTTPStatus.FORBIDDEN, "Open the address that the terminal shows: it ends in a token.")
        if path == "/":
            return _response(HTTPStatus.OK, page(), "text/html")
        if path != WEBSOCKET_PATH:
            return _response(HTTPStatus.NOT_FOUND, "There is one page here: /")
        if len(origins) != 1 or origins[0].casefold() not in (f"http://{host}", f"https://{host}"):
            return _response(HTTPStatus.FORBIDDEN, "A websocket must come from this server's own page.")
        if self._open_pages >= MAX_OPEN_PAGES:
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_OPEN_PAGES} pages are open; close one.")
        return None

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one page, from its first word to its last."""
        subject, sending = self._studio.subject, None
        outbox: asyncio.Queue[bytes] = asyncio.Queue(MAX_WAITING_MESSAGES)
        self._open_pages += 1
        try:
            with self._studio.page(partial(self._post, connection, outbox)) as client, suppress(ConnectionClosed):
                await connection.send(self._about)
                sending = asyncio.create_task(_send_all(connection, outbox))
                async for text in connection:
                    try:
                        self._studio.receive(client, parse(text, subject.recipes, len(subject.views)))
                    except UsageError as error:
                        await connection.send(message({"refused": str(error)}, []))
        finally:
            self._open_pages -= 1
            if sending is not None:
                sending.cancel()

    def _post(self, connection: ServerConnection, outbox: "asyncio.Queue[bytes]", picture: bytes) -> None:
        """Put a picture into a page's outbox, from the studio's thread; a page that reads none is cut off."""

        def put() -> None:
            if outbox.full():
                connection.transport.abort()
            else:
                outbox.put_nowait(picture)

        with suppress(RuntimeError):  # the server has closed meanwhile
            self._loop.call_soon_threadsafe(put)


async def _send_all(connection: ServerConnection, outbox: "asyncio.Queue[bytes]") -> None:
    with suppress(ConnectionClosed):  # a closed tab
        while True:
            await connection.send(await outbox.get())


def _is_local(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _response(status: HTTPStatus, text: str, kind: str = "text/plain") -> Response:
    body = f"{text}\n".encode()
    headers = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Security-Policy": "frame-ancestors 'none'",
        "Cache-Control": "no-store",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Connection": "close",
    }
    return Response(status.value, status.phrase, Headers(headers), body)
