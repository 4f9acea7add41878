"""The server: one page over HTTP, one websocket for each open page, and nothing else.

Bound to this machine alone it asks for no secret, but refuses other names of the host, under which another page could
reach it (DNS rebinding).  Bound to a network it asks for the token that is in its address.  A websocket must come from
the server's own page.  A scene file that is dropped onto a page of this machine is opened for that page alone.
"""

import asyncio
import hmac
import json
import logging
import secrets
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from errno import EADDRNOTAVAIL
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address
from os import sep, strerror
from pathlib import Path
from shutil import disk_usage
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from aaplug.live.messages import MAX_MESSAGE_BYTES, OpenRequest, parse
from aaplug.live.pictures import message
from aaplug.live.studio import Studio
from aaplug.live.subject import Subject
from aaplug.live.webpage import page
from aaplug.system.errors import AaplugError, UsageError, reason
from aaplug.system.locks import scratch

WEBSOCKET_PATH = "/live"
MAX_OPEN_PAGES = 32
MAX_WAITING_MESSAGES = 16  # to a page; one that reads leaves no more than two
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
log = logging.getLogger("aaplug.live")
log.addHandler(logging.NullHandler())
log.propagate = False  # websockets would print a traceback for each bad request


class Server:
    """Serves a studio's pages; a context, in which it listens.

    open_scene: makes a subject of a scene file.  port 0: any free one; raises UsageError if nothing can listen there.
    """

    def __init__(self, studio: Studio, open_scene: Callable[[Path], Subject], host: str, port: int):
        self._studio, self._open_scene, self._host, self._port = studio, open_scene, host, port
        self._token = None if _is_local(host) else secrets.token_urlsafe(16)
        self._open_pages = 0
        self._started: Future[tuple[asyncio.AbstractEventLoop, int]] = Future()  # with its loop and port
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="server", daemon=True)

    @property
    def address(self) -> str:
        """The address to open in a browser; by the machine's name where all of its addresses are listened on."""
        named = socket.gethostname() if self._host in ("", "0.0.0.0") else self._host
        host = f"[{named}]" if ":" in named else named
        token = "" if self._token is None else f"?token={self._token}"
        return f"http://{host}:{self._port}/{token}"

    def __enter__(self) -> "Server":
        self._about = json.dumps(self._studio.subject.about(), allow_nan=False)
        self._thread.start()
        try:
            self._loop, self._port = self._started.result()
        except (OSError, UnicodeError) as error:
            self._thread.join()
            code = None if isinstance(error, socket.gaierror | UnicodeError) else error.errno
            why = strerror(code).lower() if code else reason(error)  # asyncio's own words name the address once more
            if code in (None, EADDRNOTAVAIL):
                raise UsageError("host", f"{self._host} cannot be used: {why}") from error
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
        subject, sending, file = self._studio.subject, None, None
        outbox: asyncio.Queue[bytes] = asyncio.Queue(MAX_WAITING_MESSAGES)
        self._open_pages += 1
        try:
            with (
                scratch() as folder,
                self._studio.page(partial(self._post, connection, outbox)) as client,
                suppress(ConnectionClosed),
            ):
                await connection.send(self._about)
                sending = asyncio.create_task(_send_all(connection, outbox))
                async for said in connection:
                    try:
                        if isinstance(said, bytes) and file is not None:
                            if file.add(said):
                                subject, file = await asyncio.to_thread(self._open_scene, file.path), None
                                self._studio.show(client, subject)
                                about = await asyncio.to_thread(subject.about)  # it draws
                                await connection.send(json.dumps(about, allow_nan=False))
                            continue
                        request = parse(said, subject.recipes, len(subject.views))
                        if isinstance(request, OpenRequest):
                            file = IncomingFile(folder, request, allowed=self._token is None)
                            await connection.send(message({"take": request.name}, []))
                        else:
                            self._studio.receive(client, request)
                    except (AaplugError, MemoryError, OSError) as error:
                        file, why = None, str(error).replace(f"{folder}{sep}", "") or "out of memory"
                        await connection.send(message({"refused": why}, []))
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


class IncomingFile:
    """A scene file that a page sends in parts."""

    def __init__(self, folder: Path, request: OpenRequest, allowed: bool):
        if not allowed:
            raise UsageError(request.name, "is opened by a server that listens on this machine alone")
        if request.size > disk_usage(folder).free / 2:
            raise UsageError(request.name, f"has {request.size:,} bytes, more than the temporary folder takes")
        self.path, self._missing = folder / request.name, request.size
        self.path.write_bytes(b"")

    def add(self, part: bytes) -> bool:
        """Append a part; True at the end."""
        if len(part) > self._missing:
            raise UsageError(self.path.name, "is longer than it was announced")
        with self.path.open("ab") as stream:
            stream.write(part)
        self._missing -= len(part)
        return self._missing == 0


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
