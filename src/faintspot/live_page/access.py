"""Who may see the page and change things: hosts, origins and the token."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping

from faintspot.base.errors import InputError

_LOOPBACK = "localhost"
_HOST = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?", re.IGNORECASE | re.ASCII)
"""IPv6 address in brackets, or a name or an IPv4 address; with or without a port."""


class Access:
    """The rules.

    A page of another site must neither read nor change anything, also where its name is made to lead here
    (DNS rebinding): hosts are numbers, "localhost" or this machine's name, and a web socket comes from a page
    of the same host and port. Changes need the token; where others than this machine reach the server,
    reading does, too.

    Parameters
    ----------
    address : str
        To which the server is bound.
    private : bool
        Whether reading needs the token also on this machine, which others may use.

    Raises
    ------
    InputError
        When it is not an IP address.
    """

    def __init__(self, address: str, private: bool = False) -> None:
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            raise InputError(f"bind = {address!r:.80}: expected an IP address, such as 127.0.0.1") from None
        self.token = secrets.token_urlsafe(24)
        self.reading_needs_token = private or not parsed.is_loopback

    def permits_host(self, host: str | None) -> bool:
        """Whether a request's Host header names this machine."""
        match = _HOST.fullmatch(host or "")
        if match is None:
            return False
        version_6, name = match.groups()
        try:
            ipaddress.IPv6Address(version_6) if version_6 else ipaddress.IPv4Address(name)
        except ValueError:
            return not version_6 and name.lower() in (_LOOPBACK, socket.gethostname().lower())
        return True

    @staticmethod
    def permits_origin(headers: Mapping[str, str]) -> bool:
        """Whether a request for the web socket comes from the page itself."""
        origin, host = headers.get("Origin"), headers.get("Host")
        return bool(host) and origin == f"http://{host}"

    def knows(self, token: object) -> bool:
        """Whether it is the token; takes as long for any other."""
        return isinstance(token, str) and hmac.compare_digest(token.encode(), self.token.encode())
