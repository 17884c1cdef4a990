"""A controller of AUBO as a process."""

from __future__ import annotations

from flangeye.loopback import LoopbackOptions
from flangeye_plugins.loopback.aubo import rpc
from flangeye_plugins.loopback.aubo.controller import AuboController
from flangeye_plugins.loopback.mischief import Mischief
from flangeye_plugins.loopback.network import Network
from flangeye_plugins.loopback.server import Server, run_server
from flangeye_plugins.loopback.start import joint_zeros, starting_joints


def serve(options: LoopbackOptions) -> None:
    """Run a controller until the process is told to end.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = AuboController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    network.offer(rpc.PORT, lambda: rpc.RpcSession(network, box))
    run_server(Server(options, box, network, Mischief(box, network), {"JSON-RPC": rpc.PORT}))
