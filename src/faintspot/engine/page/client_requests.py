"""Requests that a client may make, and their answers."""

import hmac
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.base.tables import parse_changes, parse_ranges
from faintspot.engine.processes.requests import LENGTHY_TIMEOUT_S, Handler, request, since, socket_path
from faintspot.engine.telemetry.recorder import Recorder
from faintspot.slopes.estimators.registry import one_line

_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,90}\.zarr")
_MOST_CHANGES = 100


def answered(functions: Mapping[str, Handler], request: dict[str, Any]) -> dict[str, Any]:
    """Carry out a request with the function of its name; always return an answer."""
    try:
        wish = functions.get(request["do"])
        if wish is None:
            raise InputError(f"do = {request['do']!r:.40}: expected one of {', '.join(functions)}")
        return {"ok": True, **wish(request)}
    except Exception as error:  # a fault in a request must not end the server
        return {"ok": False, "error": one_line(error)}


class EngineRequests:
    """Requests passed on to an engine's control channel, which checks them; and recording of telemetry.

    Parameters
    ----------
    name : str
        Name of the engine.
    folder : path
        Folder of recordings.
    """

    def __init__(self, name: str, folder: str | Path) -> None:
        self._name, self._path = name, socket_path(name)
        self.recording = RecordingThread(name, Path(folder))

    def functions(self) -> Mapping[str, Handler]:
        """Return the functions of the requests, by name."""
        return {
            "set": self._set,
            "interleave": self._interleave,
            "loop": self._loop,
            "record": lambda request: self.recording.start(request.get("file")),
            "stop_recording": lambda request: self.recording.stop(),
        }

    def close(self) -> None:
        """End a recording."""
        self.recording.stop()

    def _set(self, request: Mapping[str, object]) -> Mapping[str, Any]:
        """Change settings: "changes" (a list of NAME=VALUE) and "subapertures" ("" for all)."""
        texts, where = request.get("changes"), request.get("subapertures") or ""
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise InputError("changes: expected a list of NAME=VALUE")
        if len(texts) > _MOST_CHANGES or not isinstance(where, str):
            raise InputError(
                f"changes: expected at most {_MOST_CHANGES}, and sub-apertures such as 4,5,10-20"
            )
        changes = parse_changes(texts)
        indices = parse_ranges(where) if where.strip() else None
        reply = self._ask("set", changes=changes, where=indices)
        return {"text": since(reply["frame"])}

    def _interleave(self, request: Mapping[str, object]) -> Mapping[str, Any]:
        """Interleave configurations as `faintspot realtime send methods=METHODS`."""
        reply = self._ask("interleave", methods=request.get("methods"), every=request.get("every"))
        return {"text": since(reply.get("frame"))}

    def _loop(self, request: Mapping[str, object]) -> Mapping[str, Any]:
        """Control the loop: "action" open, close, flat or gain, with "gain"."""
        fields = {name: request[name] for name in ("action", "gain") if request.get(name) is not None}
        loop = self._ask("loop", **fields)["loop"]
        gain = "" if loop.get("gain") is None else f", gain {loop['gain']:g}"
        return {"text": f"{loop['state']}{gain}"}

    def _ask(self, command: str, **fields: object) -> dict[str, Any]:
        return request(self._path, command, timeout_s=LENGTHY_TIMEOUT_S, **fields)


class RecordingThread:
    """Recordings, one at a time, in a separate thread.

    Parameters
    ----------
    name : str
        Name of the engine.
    folder : Path
    """

    def __init__(self, name: str, folder: Path) -> None:
        self._name, self._folder = name, folder
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._status: dict[str, object] = {"running": False}

    def start(self, file: object) -> Mapping[str, Any]:
        """Start a recording to a new store.

        Raises
        ------
        InputError
            When the file name does not end in .zarr, the store already exists, there is no engine, or a
            recording is running.
        """
        if not isinstance(file, str) or not _FILE.fullmatch(file):
            raise InputError(f"file = {file!r:.80}: expected a name such as night.zarr, without a folder")
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise InputError("file: a recording is already running; stop it first")
            recorder = Recorder(self._name, self._folder / file)
            self._stopping.clear()
            self._status = {"running": True, "file": file, "frames": 0}
            self._thread = threading.Thread(
                target=self._record, args=(recorder, file), name="faintspot-recording", daemon=True
            )
            self._thread.start()
        return {"text": f"recording to {file}"}

    def stop(self) -> Mapping[str, Any]:
        """End the recording, if there is one."""
        with self._lock:
            self._stopping.set()
            if self._thread is not None:
                self._thread.join()
        return {"text": self.status().get("text", "nothing is being recorded")}

    def status(self) -> dict[str, Any]:
        """Return the state of the present or last recording."""
        return dict(self._status)

    def _record(self, recorder: Recorder, file: str) -> None:
        def progress(frames: int) -> None:
            self._status["frames"] = frames

        try:
            report = recorder.run(stop=self._stopping, progress=progress)
        except InputError as error:
            self._status = {"running": False, "error": str(error)}
            return
        text = f"{file}: {report.frames} frames in {report.seconds:.0f} s, {report.dropped} dropped"
        self._status = {"running": False, "text": f"{text} ({report.ended_because})"}


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
