"""Who gets the page: this machine's own browser pages, and who has the token."""

import gzip
import http.client
import socket

import pytest
import viser
import websockets.asyncio.server
import websockets.exceptions
from websockets.datastructures import Headers
from websockets.http11 import Request
from websockets.sync.client import connect

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_viewer.page import server
from cmp_tactile_viewer.page.server import Access, PageServer

FORBIDDEN, OK = 403, 200
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture
def started():
    servers = []

    def start(**access):
        servers.append(PageServer(Access(**access), "test"))
        return servers[-1]

    yield start
    for one in servers:
        one.stop()


def answer(page, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", page.get_port(), timeout=30)
    connection.request("GET", path, headers=headers)
    found = connection.getresponse()
    found.body = found.read()
    connection.close()
    return found


def asked(**headers):
    return Request("/", Headers(headers))


def may_connect(page, **more):
    address = f"ws://127.0.0.1:{page.get_port()}/"
    try:
        with connect(address, subprotocols=[PROTOCOL], **more) as opened:
            opened.recv(timeout=30)
    except websockets.exceptions.InvalidStatus as error:
        return error.response.status_code != FORBIDDEN
    return True


def test_the_page_and_its_socket_are_open_to_this_machine(started):
    page = started()
    assert answer(page).status == OK
    assert may_connect(page)
    assert may_connect(page, origin=f"http://127.0.0.1:{page.get_port()}")


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_tab_has_the_name_of_the_page(started, encoding):
    found = answer(started(), **{"Accept-Encoding": encoding})
    body = gzip.decompress(found.body) if encoding == "gzip" else found.body
    assert b"<title>test</title>" in body
    assert b"<title>Viser" not in body


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "[::1", "localhost:x", "."],
)
def test_a_name_that_another_page_made_to_mean_this_machine_is_refused(started, host):
    page = started()
    assert answer(page, Host=host).status == FORBIDDEN


def test_another_page_of_the_same_browser_gets_no_socket(started):
    """No browser forbids a WebSocket to another origin by itself."""
    page = started()
    assert not may_connect(page, origin="http://evil.example")
    assert not may_connect(page, origin=f"http://127.0.0.1:{page.get_port() + 1}")
    assert not may_connect(page, origin="null")


NAME = "robot.lab.example"


@pytest.mark.parametrize("given", [NAME, "Robot.Lab.Example.", f"{NAME}:8080", f"https://{NAME}/"])
@pytest.mark.parametrize(
    ("host", "origin"),
    [
        (f"{NAME}:8123", f"http://{NAME}:8123"),
        (f"{NAME}:80", f"http://{NAME}"),
        (f"{NAME}.", f"http://{NAME}."),
        (NAME.upper(), f"http://{NAME}"),
        (NAME, f"https://{NAME}"),
        (f"{NAME}", f"https://{NAME}:8443"),
        ("127.0.0.1:8080", f"https://{NAME}"),
    ],
)
def test_a_name_that_is_allowed_opens_page_and_socket(given, host, origin):
    """The name of a name server, or of a proxy, which keeps the browser's Host or sends its own.

    NousResearch/hermes-agent 55917: a proxy sends Host 127.0.0.1 and the browser's Origin: the page
    opened and the socket was refused; it opens.
    amiantos/lurker 580: names given with a slash, a scheme or a port matched nothing; they match.
    kenn-io/agentsview 78: behind a proxy 403 without a reason; the answer names --allow-host.
    """
    for access in (Access(allow_hosts=(given,)), Access("0.0.0.0", allow_hosts=(given,))):  # noqa: S104
        guard = server.Guard(access)
        assert guard.refusal(asked(Host=host)) == ""
        assert guard.refusal(asked(Host=host, Origin=origin)) == ""
        assert guard.refusal(asked(Host=host, Origin="http://evil.example")) != ""
        assert guard.refusal(asked(Host=f"evil.{NAME}")) != ""
        assert guard.refusal(asked(Host=host, Origin=f"http://{NAME}.evil.example")) != ""


def test_a_name_that_is_not_allowed_is_told_what_to_do():
    """Both for the page and for its socket; a proxy of this machine's own name needs nothing."""
    guard = server.Guard(Access("0.0.0.0"))  # noqa: S104
    assert f"--allow-host {NAME}" in guard.refusal(asked(Host=f"{NAME}:8123"))
    assert f"--allow-host {NAME}" in guard.refusal(
        asked(Host="127.0.0.1:8080", Origin=f"https://{NAME}")
    )
    own = socket.gethostname()
    assert guard.refusal(asked(Host=own, Origin=f"https://{own}")) == ""


@pytest.mark.parametrize("given", ["*", "", "a b", "a,b", "http://", "*.lab.example"])
def test_what_is_no_name_is_refused_at_the_start(given):
    with pytest.raises(CmpTactileError, match=r"--allow-host: found .*, expected the name"):
        server.Guard(Access(allow_hosts=(given,)))


def test_a_token_is_asked_for_once_and_kept_as_a_cookie(started):
    page = started(token="open sesame")  # noqa: S106
    assert answer(page).status == FORBIDDEN
    assert answer(page, "/?token=open").status == FORBIDDEN
    assert not may_connect(page)
    first = answer(page, "/?token=open%20sesame")
    assert first.status == OK
    cookie = first.getheader("Set-Cookie")
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    kept = cookie.partition(";")[0]
    assert answer(page, "/assets", Cookie=kept).status != FORBIDDEN
    assert may_connect(page, additional_headers={"Cookie": kept})


def test_a_taken_port_is_an_error_where_it_was_asked_for_and_skipped_else(started):
    first = started()
    port = first.get_port()
    with pytest.raises(CmpTactileError, match=rf"cannot listen on 127.0.0.1, port {port}"):
        started(port=port)
    assert started().get_port() != port


def test_a_server_that_does_not_take_the_guard_is_an_error(monkeypatch):
    """Another version of viser may start its server in another way: it would be open to all."""
    monkeypatch.setattr(server, "viser", viser)
    with (
        pytest.raises(CmpTactileError, match=r"found viser .*, expected 1.1"),
        server._guarded(server.Guard(Access()), "test"),
    ):
        pass
    assert websockets.asyncio.server.serve.__module__ != server.__name__


def test_nobody_can_ask_for_a_tunnel_to_the_internet(started):
    assert started().request_share_url() is None
