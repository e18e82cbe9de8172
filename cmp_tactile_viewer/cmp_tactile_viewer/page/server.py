"""A viser server that is safe by default: only this machine, only its own page, no tunnel."""

from __future__ import annotations

import gzip
import hashlib
import html
import http
import io
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from cmp_tactile_processing.errors import CmpTactileError

LOCAL = ("127.0.0.1", "localhost", "::1")
DEFAULT_PORT = 8080
# Of a page that is refused: one sentence that says what to do.
ASK_FOR_ADDRESS = (
    "This page needs its token: open the address that the program printed; it ends in ?token=..."
)
# Refused at another name: what was found, and what the user can do about it.
OTHER_NAME = (
    "Refused: found the name {name!r}, expected a name of this page. If it names this machine "
    "or a proxy, start the page with --allow-host {name} (launch files: view_allow_host:={name}; "
    "node: the parameter allow_hosts)."
)
NO_NAME = "Refused: found {found!r} in the header {header}, expected the name of a machine."
# A name as an attacker may send it is not repeated at any length.
LONGEST_NAME = 253
# Ports that an address need not state; a proxy may serve https and ask the page by http.
UNSTATED_PORTS = (80, 443, None)
_serving = threading.Lock()

Answer = Callable[[Any, Request], Response | None]


@dataclass(frozen=True)
class Access:
    """Who may see the page, and press its buttons.

    host: address to listen on.  port: None for the first that is free from DEFAULT_PORT on.
    token: that an address must have; empty for none.  read_only: no buttons, no parameters.
    allow_hosts: further names of this machine, or of proxies before it, that addresses may have.
    """

    host: str = "127.0.0.1"
    port: int | None = None
    token: str = ""
    read_only: bool = False
    allow_hosts: tuple[str, ...] = ()

    @property
    def is_local(self) -> bool:
        """Whether only this machine can connect."""
        return self.host in LOCAL


class PageServer(viser.ViserServer):  # type: ignore[misc,unused-ignore]
    """Viser without its tunnel, and with a guard before every request."""

    def __init__(self, access: Access, title: str) -> None:
        """Raises CmpTactileError where the address cannot be listened on."""
        self.access = access
        _check_address(access)
        with _guarded(Guard(access), title), redirect_stdout(io.StringIO()):
            super().__init__(access.host, access.port or DEFAULT_PORT, title, verbose=False)
        port = self.get_port()
        if access.port not in (None, 0, port):
            self.stop()
            msg = f"port {access.port} of {access.host} is taken: choose another one with --port"
            raise CmpTactileError(msg)

    @property
    def url(self) -> str:
        """The address to open, with its token."""
        host = self.access.host
        if host in ("0.0.0.0", "::"):  # noqa: S104
            host = socket.gethostname()
        elif ":" in host:
            host = f"[{host}]"
        token = f"/?token={quote(self.access.token, safe='')}" if self.access.token else ""
        return f"http://{host}:{self.get_port()}{token}"

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Nothing leaves this machine: viser's own would open a tunnel for whoever asks."""
        return None

    def stop(self) -> None:
        """End; the browsers look for the page again until it is back."""
        with redirect_stdout(io.StringIO()):
            super().stop()


def _check_address(access: Access) -> None:
    """Listen for a moment: viser would try a thousand ports in silence."""
    try:
        family = socket.getaddrinfo(access.host, None, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((access.host, access.port or 0))
    except OSError as error:
        where = f"{access.host}, port {access.port}" if access.port else access.host
        msg = f"cannot listen on {where}: {error.strerror or error}"
        raise CmpTactileError(msg) from None


class Guard:
    """Answers requests that must not reach the page; None for those that may."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._allowed = frozenset(_allowed_name(name) for name in access.allow_hosts)
        # Pages on other ports of a machine get the same cookies: each has a name of its own.
        self.cookie = f"cmp_tactile_{hashlib.sha256(access.token.encode()).hexdigest()[:8]}"

    def refusal(self, request: Request) -> str:
        """Why a request is refused; empty for one that may pass.

        A page elsewhere may send requests to this machine from the user's browser: by name
        resolution that changes (another Host), or by a WebSocket, which no browser forbids
        (another Origin).  A proxy may send its own Host with the browser's Origin.
        """
        host, origin = (request.headers.get(header) for header in ("Host", "Origin"))
        place = _place(f"//{host or ''}")
        if place is None:
            return NO_NAME.format(header="Host", found=(host or "")[:LONGEST_NAME])
        if not (place[0] in self._allowed or self._is_own_name(place[0])):
            return OTHER_NAME.format(name=place[0])
        if origin is not None:
            source = _place(origin)
            if source is None:
                return NO_NAME.format(header="Origin", found=origin[:LONGEST_NAME])
            if source != place and source[0] not in self._allowed:
                return OTHER_NAME.format(name=source[0])
        return "" if self.token_of(request) is not None else ASK_FOR_ADDRESS

    def token_of(self, request: Request) -> str | None:
        """The right token of a request, "" where none is needed, None where it has not got it."""
        expected = self._access.token
        if not expected:
            return ""
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        try:
            cookie = SimpleCookie(request.headers.get("Cookie", "")).get(self.cookie)
        except CookieError:
            cookie = None
        if cookie is not None:
            given.append(unquote(cookie.value))
        right = (secrets.compare_digest(item.encode(), expected.encode()) for item in given)
        return expected if any(right) else None

    def _is_own_name(self, name: str) -> bool:
        if name in LOCAL:
            return True
        if self._access.is_local:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            own = socket.gethostname().lower()
            return name in (self._access.host.lower(), own, f"{own}.local", _full_name())
        return True


def _full_name() -> str:
    return socket.getfqdn().lower().rstrip(".")


def _place(url: str) -> tuple[str, int | None] | None:
    """Name in lower case without the dot of the root, and port of an address; None for no name."""
    try:
        parts = urlsplit(url)
        name, port = (parts.hostname or "").rstrip("."), parts.port
    except ValueError:
        return None
    if not name or len(name) > LONGEST_NAME:
        return None
    return name, None if port in UNSTATED_PORTS else port


def _allowed_name(text: str) -> str:
    """The name in what a user gives: a name, with a port, or the address of a page."""
    place = _place(text if "//" in text else f"//{text}")
    if place is None or any(sign in text for sign in "*, "):
        msg = f"--allow-host: found {text!r}, expected the name of a machine, as robot.lab.example"
        raise CmpTactileError(msg)
    return place[0]


def _give_title(response: Response, title: str) -> None:
    """Name the browser's tab: viser has its own name there."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    page = gzip.decompress(response.body) if is_packed else response.body
    named = f"<title>{html.escape(title)}</title>".encode()
    page = page.replace(b"<title>Viser</title>", named, 1)
    response.body = gzip.compress(page) if is_packed else page
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


def _with_guard(guard: Guard, title: str, answer: Answer) -> Answer:
    def answered(connection: Any, request: Request) -> Response | None:
        reason = guard.refusal(request)
        if reason:
            body = reason.encode()
            size = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
            status = http.HTTPStatus.FORBIDDEN
            return Response(status.value, status.phrase, Headers(size), body)
        response = answer(connection, request)
        if response is not None:
            _give_title(response, title)
        token = guard.token_of(request)
        if response is not None and token:
            value = f"{guard.cookie}={quote(token, safe='')}"
            response.headers["Set-Cookie"] = f"{value}; HttpOnly; SameSite=Strict; Path=/"
        return response

    return answered


@contextmanager
def _guarded(guard: Guard, title: str) -> Iterator[None]:
    """Viser has no place for a guard: while a server starts, it gets a `serve` that sets one.

    Raises CmpTactileError where the server did not take it: it would be open to everybody.
    """
    original = websockets.asyncio.server.serve
    taken = []

    def serve(*args: Any, process_request: Answer, **options: Any) -> Any:
        taken.append(True)
        answer = _with_guard(guard, title, process_request)
        return original(*args, process_request=answer, **options)

    # websockets logs a traceback for every browser that closes its connection in the middle.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with _serving:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]
    if not taken:
        msg = f"found viser {viser.__version__}, whose access cannot be restricted, expected 1.1"
        raise CmpTactileError(msg)
