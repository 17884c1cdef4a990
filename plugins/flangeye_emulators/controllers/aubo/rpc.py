"""The port: frames of a mark, a length and a body; JSON-RPC 2.0 in them, after a login."""

from __future__ import annotations

import json
import struct
from typing import Any

from flangeye_emulators.controllers.aubo.controller import AuboController
from flangeye_emulators.controllers.aubo.methods import METHODS, ROBOT
from flangeye_emulators.controllers.network import Connection, Network

PORT = 30004
MARK = b"SOF\x01"


UNKNOWN_METHOD, WRONG_PARAMS = -32601, -32602
"""JSON-RPC 2.0, section 5.1."""

_LENGTH = struct.Struct(">I")
_HEADER = len(MARK) + _LENGTH.size


class RpcSession(Connection):
    """One client."""

    def __init__(self, network: Network, box: AuboController) -> None:
        super().__init__(network)
        self._box = box
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Answer each whole frame."""
        self._buffer += data
        while len(self._buffer) >= _HEADER:
            (length,) = _LENGTH.unpack_from(self._buffer, len(MARK))
            # Bytes of a body after which a client is cut off
            if not self._buffer.startswith(MARK) or length > 1 << 20:
                self.abort()
                return
            if len(self._buffer) < _HEADER + length:
                return
            body = self._buffer[_HEADER : _HEADER + length]
            self._buffer = self._buffer[_HEADER + length :]
            self.send(frame(answer(self._box, body)))


def frame(body: bytes) -> bytes:
    """Return a body with its mark and length."""
    return MARK + _LENGTH.pack(len(body)) + body


def answer(box: AuboController, body: bytes) -> bytes:
    """Return the answer to one request, after doing what it says."""
    if body.startswith(b"__login__"):
        # The client takes any answer.
        return b"OK"
    try:
        request = json.loads(body)
        said = {"id": request["id"], **_outcome(box, request)}
    except (ValueError, KeyError, TypeError):
        said = {"id": None, **_error(-32600, "not a request")}
    return json.dumps({"jsonrpc": "2.0", **said}).encode()


def _outcome(box: AuboController, request: dict[str, Any]) -> dict[str, Any]:
    name = str(request["method"]).removeprefix(f"{ROBOT}.")
    method = METHODS.get(name)
    if method is None:
        return _error(UNKNOWN_METHOD, f"{name} is not simulated")
    try:
        return {"result": method(box, request.get("params", {}))}
    except (KeyError, TypeError, ValueError) as error:
        return _error(WRONG_PARAMS, f"{name}: {type(error).__name__}: {error}")


def _error(code: int, message: str) -> dict[str, Any]:
    return {"error": {"code": code, "message": message}}
