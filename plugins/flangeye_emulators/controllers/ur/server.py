"""A controller of Universal Robots as a process."""

from __future__ import annotations

from flangeye.models.emulator import EmulatorOptions
from flangeye_emulators.controllers.network import Network
from flangeye_emulators.controllers.server import Server, run_server
from flangeye_emulators.controllers.start import joint_zeros, starting_joints
from flangeye_emulators.controllers.ur import dashboard, rtde, scriptport
from flangeye_emulators.controllers.ur.controller import URController
from flangeye_emulators.controllers.ur.faults import URFaultInjector


def serve(options: EmulatorOptions) -> None:
    """Run a controller until the process is asked to end.

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
    run_server(Server(options, box, network, URFaultInjector(box, network), ports), stream.publish)
