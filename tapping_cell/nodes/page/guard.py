"""Who may speak to the page: the right Host, the right Origin, the right token.

A browser lets every web site open a WebSocket to every address. The Origin says which site asks,
the Host says by which name: a site that makes its own name point here (DNS rebinding) is known by
a name that is not this machine's.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


def is_loopback(address: str) -> bool:
    """Whether an address to bind to is reached from this machine alone."""
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def make_token() -> str:
    """A new token of 128 random bits, fit for a URL."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class Guard:
    """What a request must show."""

    names: tuple[str, ...]
    """Host names under which the page may be asked for."""
    token: str
    """What a page must know; empty: nothing."""
    addresses: bool
    """Whether any address in numbers is taken as Host, too: it cannot be rebound."""

    @classmethod
    def make(cls, address: str, more_names: Iterable[str], token: str) -> Guard:
        """For a server bound to ``address``; without a token given, one is made where the page is
        reached from other machines.
        """
        local = is_loopback(address)
        own = () if local else (socket.gethostname(), f"{socket.gethostname()}.local")
        names = {name.strip().lower() for name in (*LOOPBACK_NAMES, *own, *more_names)}
        return cls(
            names=tuple(sorted(names - {""})),
            token=token or ("" if local else make_token()),
            addresses=not local,
        )

    def refusal(
        self, host: str, origin: str | None, *, command: bool, page_port: int | None = None
    ) -> str:
        """Why a request is refused, in words; empty where it is not.

        ``host`` and ``origin`` are the request's headers; a ``command`` (a WebSocket, a POST) must
        have an Origin, a page that is only read need not. ``page_port`` is where the page is served
        that may ask, where that is not the port of the request itself.
        """
        name = host_name(host)
        if name is None or not self._known(name):
            return (
                f"this page is not served under the name '{host[:100]}'; open it by address, or "
                "add the name to the parameter host_names of operator_page"
            )
        if origin is None:
            return "a request without an Origin is not taken" if command else ""
        parts = urlsplit(origin) if _plain(origin) else None
        expected = host if page_port is None else _with_port(name, page_port)
        if parts is None or parts.scheme not in ("http", "https") or parts.netloc != expected:
            return f"a page of {origin[:100]} may not speak to this cell"
        return ""

    def admits(self, token: object) -> bool:
        """Whether a token is the right one; takes the same time for every wrong one."""
        if not self.token:
            return True
        given = token if isinstance(token, str) else ""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def _known(self, name: str) -> bool:
        if name in self.names:
            return True
        if not self.addresses:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def _plain(text: str) -> bool:
    return text.isascii() and text.isprintable() and " " not in text


def host_name(host: str) -> str | None:
    """The name in a Host header, without port and brackets; None where it is malformed."""
    if not _plain(host) or any(sign in host for sign in "/@?#\\"):
        return None
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return None
    return parts.hostname


def _with_port(name: str, port: int) -> str:
    """Name and port as a browser writes them in Origin: without the port of http itself."""
    shown = f"[{name}]" if ":" in name else name
    return shown if port == 80 else f"{shown}:{port}"


def urls(address: str, port: int, token: str) -> list[str]:
    """Where the page is opened. The token stands behind the #: browsers never send that part, so it
    is in nobody's log.
    """
    tail = f":{port}/" + (f"#token={token}" if token else "")
    if is_loopback(address):
        return [f"http://{'[::1]' if address == '::1' else 'localhost'}{tail}"]
    names = [socket.gethostname()]
    if address in ("0.0.0.0", "::", ""):
        names.append(_outward_address())
    else:
        names = [f"[{address}]" if ":" in address else address]
    return [f"http://{name}{tail}" for name in names if name]


def _outward_address() -> str:
    """This machine's address on its network; empty where it has none. Sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address of documentation (RFC 5737)
        except OSError:
            return ""
        found: str = probe.getsockname()[0]
        return found
