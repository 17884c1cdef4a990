# mypy: ignore-errors
"""The tf tree: what a camera's driver and robot_state_publisher tell, and what is heard of it."""

import json
import os
import sys
import time
from contextlib import suppress

from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from tests.plugins.ros2.peers.node import LATCHED, rclpy, say, serve


class Frames:
    def __init__(self, node, options):
        self.heard = {}
        self.still = node.create_publisher(TFMessage, "/tf_static", LATCHED)
        self.moving = node.create_publisher(TFMessage, "/tf", 10)
        self.standing, self.going = ([_transform(t) for t in options[k]] for k in ("static", "tf"))
        self.still.publish(TFMessage(transforms=self.standing))
        node.create_subscription(TFMessage, "/tf_static", self.hears, LATCHED)
        node.create_timer(0.02, self.tell)

    def tell(self):
        for each in self.going:
            now = time.time()
            each.header.stamp.sec, each.header.stamp.nanosec = int(now), int(now % 1 * 1e9)
        if self.going:
            self.moving.publish(TFMessage(transforms=self.going))

    def hears(self, message):
        for each in message.transforms:
            move, turn = each.transform.translation, each.transform.rotation
            self.heard[each.child_frame_id] = (
                each.header.frame_id,
                [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w],
            )

    def obey(self, words):
        if "heard" in words:
            say(heard=self.heard)


def _transform(given):
    parent, child, numbers = given
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id = parent
    move, turn = found.transform.translation, found.transform.rotation
    move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w = map(float, numbers)
    return found


def main():
    options = json.loads(sys.argv[1])
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    rclpy.init()
    node = rclpy.create_node("frames")
    serve(node, Frames(node, options).obey)


if __name__ == "__main__":
    main()
