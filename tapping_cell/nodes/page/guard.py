"""Access control of the page by Host header, Origin header and token.

A browser lets any web site open a WebSocket to any address. The Origin header identifies the web
site, and the Host header contains the requested host name. A site that resolves its own name to
this machine (DNS rebinding) is detected because that name does not belong to this machine.
"""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import SplitResult, quote, urlsplit

from tapping_cell.durable_file import part_of, replace_text

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


def is_loopback(address: str) -> bool:
    """Return whether a bind address is reachable only from this machine."""
    parsed = _parsed(address)
    return address == "localhost" or (parsed is not None and parsed.is_loopback)


def _parsed(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return a numeric address; None if it is not numeric."""
    try:
        return ipaddress.ip_address(address)
    except ValueError:
        return None


def make_token() -> str:
    """Return a new token of 128 random bits that is valid in a URL."""
    return secrets.token_urlsafe(16)


def kept_token(file: Path) -> str:
    """Return the token in a file, so that a bookmark of the page survives a restart. A missing or
    empty file gets a new token. Only its owner may read the file.

    Raises:
        OSError: the file cannot be read or written.
    """
    with contextlib.suppress(FileNotFoundError):
        if token := file.read_text(encoding="ascii", errors="replace").strip():
            return token
    file.parent.mkdir(parents=True, exist_ok=True)
    part_of(file).unlink(missing_ok=True)
    part_of(file).touch(0o600)
    token = make_token()
    replace_text(file, token + "\n")
    return token


@dataclass(frozen=True, slots=True)
class Guard:
    """Requirements for a request."""

    names: tuple[str, ...]
    """Host names by which the page may be requested."""
    token: str
    """Token that a page must send; empty if no token is required."""
    addresses: bool
    """Whether any numeric address is also accepted as Host. Accepting addresses does not permit DNS
    rebinding, because DNS rebinding needs a name."""

    @classmethod
    def make(cls, address: str, more_names: Iterable[str], token: str) -> Guard:
        """Return the guard of a server bound to ``address``. If ``token`` is empty and the page is
        reachable from other machines, a token is generated."""
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
        """Return the reason why a request is refused, or an empty text.

        ``host`` and ``origin`` are the headers of the request. A ``command`` (a WebSocket, a POST)
        must have an Origin; a read-only request need not. ``page_port`` is the port of the page
        that may send the request, if it differs from the port of the request.
        """
        name = host_name(host)
        if name is None or not self._known(name):
            return (
                f"this page is not served under the name '{host[:100]}'; open it by address, or "
                "add the name to the parameter host_names of operator_page"
            )
        if origin is None:
            return "a request without an Origin header is not accepted" if command else ""
        parts = _split(origin) if _plain(origin) else None
        expected = host if page_port is None else _with_port(name, page_port)
        if parts is None or parts.scheme not in ("http", "https") or parts.netloc != expected:
            return f"a page from {origin[:100]} may not connect to this cell"
        return ""

    def admits(self, token: object) -> bool:
        """Return whether a token is correct. The comparison takes constant time."""
        if not self.token:
            return True
        given = token if isinstance(token, str) else ""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode())

    def _known(self, name: str) -> bool:
        return name in self.names or (self.addresses and _parsed(name) is not None)


def _plain(text: str) -> bool:
    return text.isascii() and text.isprintable() and " " not in text


def _split(url: str) -> SplitResult | None:
    """Return the parts of a URL; None if it is malformed."""
    try:
        return urlsplit(url)
    except ValueError:
        return None


def host_name(host: str) -> str | None:
    """Return the host name in a Host header, without port and brackets; None if it is malformed."""
    if not _plain(host) or any(sign in host for sign in "/@?#\\"):
        return None
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return None
    return parts.hostname


def _with_port(name: str, port: int) -> str:
    """Return name and port as in an Origin header, which omits the default port of HTTP."""
    shown = f"[{name}]" if ":" in name else name
    return shown if port == 80 else f"{shown}:{port}"


def urls(address: str, port: int, token: str) -> list[str]:
    """Return the URLs of the page. The token follows the #. Browsers do not send this part of a
    URL, so the token appears in no server's log."""
    tail = f":{port}/" + (f"#token={quote(token, safe='')}" if token else "")
    if is_loopback(address):
        return [f"http://{'[::1]' if address == '::1' else 'localhost'}{tail}"]
    names = [socket.gethostname()]
    if address in ("0.0.0.0", "::", ""):
        names.append(_outward_address())
    else:
        names = [f"[{address}]" if ":" in address else address]
    return [f"http://{name}{tail}" for name in names if name]


def _outward_address() -> str:
    """Return this machine's address on its network, or an empty text. No packet is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # documentation address (RFC 5737)
        except OSError:
            return ""
        found: str = probe.getsockname()[0]
        return found
