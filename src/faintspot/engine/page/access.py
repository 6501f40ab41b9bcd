"""Access control of the page: permitted hosts and origins, and the token."""

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
    """Rules that decide who may read the page and change settings.

    Pages of other sites must neither read nor change anything, even if their name is made to resolve to this
    machine (DNS rebinding). So hosts must be numbers, "localhost" or this machine's name, and a web socket
    must come from a page of the same host and port. Changes need the token; if other machines can reach the
    server, reading needs it, too.

    Parameters
    ----------
    address : str
        Address to which the server is bound.
    private : bool
        Whether reading needs the token even on this machine, which other users may share.

    Raises
    ------
    InputError
        When the address is not an IP address.
    """

    def __init__(self, address: str, private: bool = False) -> None:
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            raise InputError(f"bind = {address!r:.80}: expected an IP address, such as 127.0.0.1") from None
        self.token = secrets.token_urlsafe(24)
        self.reading_needs_token = private or not parsed.is_loopback

    def permits_host(self, host: str | None) -> bool:
        """Return whether a request's Host header names this machine."""
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
        """Return whether a request for the web socket comes from the page itself."""
        origin, host = headers.get("Origin"), headers.get("Host")
        return bool(host) and origin == f"http://{host}"

    def knows(self, token: object) -> bool:
        """Compare with the token, in a time that does not depend on the content."""
        return isinstance(token, str) and hmac.compare_digest(token.encode(), self.token.encode())
