"""Requests to a running engine that may take long."""

from __future__ import annotations

import threading
from typing import Any

import click

from faintspot.realtime.control import LENGTHY_TIMEOUT_S, request
from faintspot.realtime.private_socket import socket_path

PATIENCE_S = 2.0
"""Delay before the reason for waiting is printed."""


def asked_at_length(name: str, command: str, **fields: Any) -> dict[str, Any]:
    """Ask for a change, for which the engine may compile; see `faintspot.realtime.control.request`."""
    reason = "waiting: the engine goes on, and compiles what this machine has not used yet"
    timer = threading.Timer(PATIENCE_S, click.echo, [reason], {"err": True})
    timer.daemon = True
    timer.start()
    try:
        return request(socket_path(name), command, timeout_s=LENGTHY_TIMEOUT_S, **fields)
    finally:
        timer.cancel()
