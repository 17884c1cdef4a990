"""What the peers share: the real rclpy behind the tests' own packages, and words on standard input."""

import json
import os
import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)

__all__ = ["LATCHED", "SENSOR", "rclpy", "say", "serve"]

LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
SENSOR = qos_profile_sensor_data


def say(**words):
    print(json.dumps(words), flush=True)


def serve(node, obey):
    """Spin until standard input ends; each of its lines is a JSON object for ``obey``."""

    def listen():
        for line in sys.stdin:
            obey(json.loads(line))
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    say(ready=True)
    executor.spin()
