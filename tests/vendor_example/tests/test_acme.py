"""What flangeye asks of each plugin, and what Acme knows besides."""

import socketserver
import threading

import numpy as np
import pytest
from acme_flangeye import fit_hull
from acme_flangeye.cost import cost_largest_axis
from acme_flangeye.scanner import AcmeParams, scanner_acme

from flangeye.devices import DeviceError
from flangeye.testing import CostConformance, FitConformance, ScannerConformance


class TestFitHull(FitConformance):
    stage = fit_hull
    params = {"tolerance": "2 mm"}
    tolerance = 1e-3


class TestCostLargestAxis(CostConformance):
    part = cost_largest_axis


class Counterpart(socketserver.StreamRequestHandler):
    """A scanner on this machine: a plate 0.7 m away, with one point missing."""

    def handle(self):
        xyz = np.full((30, 40, 3), 700.0, dtype="<f4")
        xyz[0, 0] = np.nan
        for line in self.rfile:
            question = line.decode().strip()
            told = {"WHO": "0042 mm 40 30", "EXPOSE": "done", "GET": str(xyz.nbytes)}
            self.wfile.write(f"{told[question]}\n".encode())
            if question == "GET":
                self.wfile.write(xyz.tobytes())


class Server(socketserver.ThreadingTCPServer):
    daemon_threads = True


@pytest.fixture(scope="class")
def counterpart(request):
    with Server(("127.0.0.1", 0), Counterpart) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        request.cls.params = {"host": "127.0.0.1", "port": server.server_address[1]}
        yield
        server.shutdown()


@pytest.mark.usefixtures("counterpart")
class TestScannerAcme(ScannerConformance):
    part = scanner_acme
    unreachable = AcmeParams(host="127.0.0.1", port=9)


def test_no_scanner_is_one_line():
    with pytest.raises(DeviceError, match="no scanner at 127.0.0.1:9 .*; is it on?"):
        scanner_acme(None, AcmeParams(host="127.0.0.1", port=9))
