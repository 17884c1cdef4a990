"""Acme's scanner, offered as scanner.acme: it speaks lines over TCP, and sends millimetres."""

import socket
import time

import numpy as np

from flangeye import Params, part
from flangeye.devices import PATIENCE, DeviceError, Scan, Scanner
from flangeye.models.scanners import ScannerModel
from flangeye.types import CAMERA, PointCloud


class AcmeParams(Params):
    host: str = "192.168.0.10"
    """Address of the scanner."""
    port: int = 7700
    """Its port."""


@part("scanner.acme")
def scanner_acme(model: ScannerModel | None, params: AcmeParams) -> Scanner:
    """Scan with an Acme scanner over TCP."""
    where = f"{params.host}:{params.port}"
    try:
        link = socket.create_connection((params.host, params.port), timeout=PATIENCE)
    except OSError as error:
        raise DeviceError(f"scanner.acme: no scanner at {where} ({error}); is it on?") from None
    return AcmeScanner(link, where)


class AcmeScanner:
    def __init__(self, link, where):
        self.name, self._link, self._file = f"Acme at {where}", link, link.makefile("rwb")
        serial, unit, columns, rows = self._ask("WHO").split()
        if unit != "mm":
            raise DeviceError(f"{self.name}: sends {unit}, mm are expected; update its firmware")
        self.name, self._shape = f"Acme {serial}", (int(rows), int(columns), 3)
        self.facts = {"unit": unit, "layout": f"organised, {columns} x {rows}"}

    def expose(self):
        started = time.monotonic_ns()
        self._ask("EXPOSE")
        ended = time.monotonic_ns()
        return lambda: Scan(self._cloud(), started, ended)

    def close(self):
        self._link.close()

    def _cloud(self):
        size = int(self._ask("GET"))
        data = self._file.read(size)
        xyz = np.frombuffer(data, dtype="<f4").reshape(self._shape) / np.float32(1000)
        return PointCloud(CAMERA, xyz)  # what it did not measure, it sends as NaN

    def _ask(self, question):
        try:
            self._file.write(f"{question}\n".encode())
            self._file.flush()
            answer = self._file.readline().decode().strip()
        except (OSError, ValueError) as error:
            raise DeviceError(f"{self.name}: lost ({error})") from None
        if not answer:
            raise DeviceError(f"{self.name}: lost (it ended the connection)")
        return answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
