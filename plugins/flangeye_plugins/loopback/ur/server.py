"""A controller of Universal Robots as a process."""

from __future__ import annotations

from flangeye.loopback import LoopbackOptions
from flangeye_plugins.loopback.network import Network
from flangeye_plugins.loopback.server import Server, run_server
from flangeye_plugins.loopback.start import joint_zeros, starting_joints
from flangeye_plugins.loopback.ur import dashboard, rtde, scriptport
from flangeye_plugins.loopback.ur.controller import URController
from flangeye_plugins.loopback.ur.faults import URMischief


def serve(options: LoopbackOptions) -> None:
    """Run a controller until the process is told to end.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = URController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    stream = rtde.RtdePort(network, box)
    network.offer(scriptport.PORT, lambda: scriptport.ScriptSession(network, box))
    network.offer(dashboard.PORT, lambda: dashboard.DashboardSession(network, box))
    ports = {"RTDE": rtde.PORT, "script": scriptport.PORT, "dashboard": dashboard.PORT}
    run_server(Server(options, box, network, URMischief(box, network), ports), stream.publish)
