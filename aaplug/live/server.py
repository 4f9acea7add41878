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
from collections.abc import Awaitable, Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from errno import EADDRNOTAVAIL
from http import HTTPStatus
from ipaddress import ip_address
from os import sep, strerror
from pathlib import Path
from shutil import disk_usage
from urllib.parse import parse_qs

import torch
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from aaplug.live import webpage
from aaplug.live.messages import MAX_MESSAGE_BYTES, OpenRequest, parse
from aaplug.live.pictures import Page, message
from aaplug.live.subject import Subject
from aaplug.system.errors import AaplugError, UsageError, reason
from aaplug.system.executors import given_threads
from aaplug.system.locks import scratch

WEBSOCKET_PATH = "/live"
MAX_OPEN_PAGES = 32
CLOSE_SECONDS = 1.0  # for a page's last word at the server's end; a page that sleeps has none
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
log = logging.getLogger("aaplug.live")
log.addHandler(logging.NullHandler())
log.propagate = False  # websockets would print a traceback for each bad request


class Server:
    """Serves pages that show a subject; a context, in which it listens.

    One thread draws for all pages in turn, a step for each that wants one.

    open_scene: makes a subject of a scene file.  port 0: any free one; raises UsageError if nothing can listen there.
    """

    def __init__(self, subject: Subject, open_scene: Callable[[Path], Subject], host: str, port: int):
        self._subject, self._open_scene, self._host, self._port = subject, open_scene, host, port
        self._drawing = ThreadPoolExecutor(1, "drawing", torch.set_num_threads, (given_threads(),))
        self._token = None if _is_local(host) else secrets.token_urlsafe(16)
        self._open_pages = 0
        self._started: Future[tuple[asyncio.AbstractEventLoop, int]] = Future()  # with its loop and port
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="server", daemon=True)

    @property
    def address(self) -> str:
        """The address to open in a browser; by the machine's name where all of its addresses are listened on."""
        named = socket.gethostname() if self._host in ("", "0.0.0.0") else self._host
        host = f"[{named}]" if ":" in named else named
        token = "" if self._token is None else f"?token={self._token}"
        return f"http://{host}:{self._port}/{token}"

    def __enter__(self) -> "Server":
        self._first = _shown(self._subject)
        self._thread.start()
        try:
            self._loop, self._port = self._started.result()
        except (OSError, UnicodeError) as error:  # the latter: no host can have this name
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
        self._drawing.shutdown()

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:
            if self._started.done():
                raise
            self._started.set_exception(error)  # whoever started it waits

    async def _serve(self) -> None:
        limits = {"max_size": MAX_MESSAGE_BYTES, "max_queue": 16, "compression": None, "close_timeout": CLOSE_SECONDS}
        options = limits | {"process_request": self._answer, "logger": log, "server_header": None}
        async with await serve(self._talk, self._host, self._port, **options) as listener:
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
            return _response(HTTPStatus.OK, webpage.page(), "text/html")
        if path != WEBSOCKET_PATH:
            return _response(HTTPStatus.NOT_FOUND, "There is one page here: /")
        if len(origins) != 1 or origins[0].casefold() not in (f"http://{host}", f"https://{host}"):
            return _response(HTTPStatus.FORBIDDEN, "A websocket must come from this server's own page.")
        if self._open_pages >= MAX_OPEN_PAGES:
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_OPEN_PAGES} pages are open; close one.")
        return None

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one page, from its first word to its last."""
        shown: tuple[Subject, str] | None = self._first
        self._open_pages += 1
        try:
            with scratch() as folder, suppress(ConnectionClosed):
                while shown is not None:
                    subject, about = shown
                    await connection.send(about)
                    page = Page(subject)
                    drawing = asyncio.create_task(self._draw(page, connection.send))
                    try:
                        shown = await self._listen(connection, page, folder)
                    finally:
                        drawing.cancel()
        finally:
            self._open_pages -= 1

    async def _draw(self, page: Page, send: Callable[[bytes], Awaitable[None]]) -> None:
        """Send what a page wants; its next step waits until the last is sent, and behind those of other pages."""
        with suppress(ConnectionClosed):  # a closed tab
            while True:
                page.changed.clear()
                while page.busy:
                    picture = await asyncio.get_running_loop().run_in_executor(self._drawing, page.step)
                    if picture is not None:
                        page.sent += 1
                        await send(picture)
                await page.changed.wait()

    async def _listen(self, connection: ServerConnection, page: Page, folder: Path) -> tuple[Subject, str] | None:
        """Hear a page, until it has sent the file of another scene, which is returned as by `_shown`, or is closed."""
        file = None
        async for said in connection:
            try:
                if isinstance(said, bytes) and file is not None:
                    if path := file.send(said):
                        subject = await asyncio.to_thread(self._open_scene, path)
                        return await asyncio.to_thread(_shown, subject)
                    continue
                request = parse(said, page.subject.recipes, len(page.subject.views))
                if isinstance(request, OpenRequest):
                    file = _incoming(folder, request, allowed=self._token is None)
                    next(file)
                    await connection.send(message({"take": request.name}, []))
                else:
                    page.receive(request)
            except (AaplugError, MemoryError, OSError) as error:
                file, why = None, str(error).replace(f"{folder}{sep}", "") or "out of memory"
                await connection.send(message({"refused": why}, []))
        return None


def _shown(subject: Subject) -> tuple[Subject, str]:
    """A subject, and what a page is told of it, which takes some drawing."""
    return subject, json.dumps(subject.about(), allow_nan=False)


def _incoming(folder: Path, request: OpenRequest, allowed: bool) -> Generator[Path | None, bytes, None]:
    """Write a scene file that a page sends in parts, which are sent to this generator; yields its path at the end."""
    if not allowed:
        raise UsageError(request.name, "is opened by a server that listens on this machine alone")
    if request.size > disk_usage(folder).free / 2:
        raise UsageError(request.name, f"has {request.size:,} bytes, more than the temporary folder takes")
    path, missing = folder / request.name, request.size
    with path.open("wb") as stream:
        while missing:
            part = yield None
            if len(part) > missing:
                raise UsageError(request.name, "is longer than it was announced")
            stream.write(part)
            missing -= len(part)
    yield path


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
