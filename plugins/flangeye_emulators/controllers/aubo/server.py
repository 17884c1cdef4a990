"""A controller of AUBO as a process."""

from __future__ import annotations

from flangeye.models.emulator import EmulatorOptions
from flangeye_emulators.controllers.aubo import rpc
from flangeye_emulators.controllers.aubo.controller import AuboController
from flangeye_emulators.controllers.fault_injection import FaultInjector
from flangeye_emulators.controllers.network import Network
from flangeye_emulators.controllers.server import Server, run_server
from flangeye_emulators.controllers.start import joint_zeros, starting_joints


def serve(options: EmulatorOptions) -> None:
    """Run a controller until the process is asked to end.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = AuboController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    network.offer(rpc.PORT, lambda: rpc.RpcSession(network, box))
    run_server(Server(options, box, network, FaultInjector(box, network), {"JSON-RPC": rpc.PORT}))
