"""``export.*``: the camera pose as another program takes it. Add a format: with its like here."""

from flangeye_plugins.export.controllers import (
    export_abb,
    export_doosan,
    export_fanuc,
    export_kuka,
    export_staubli,
    export_ur,
    export_yaskawa,
)
from flangeye_plugins.export.easy_handeye2 import export_easy_handeye2
from flangeye_plugins.export.programs import (
    export_halcon,
    export_matrix,
    export_mech_mind,
    export_opencv,
    export_robodk,
    export_zivid,
)
from flangeye_plugins.export.ros2 import export_moveit, export_ros2_command, export_ros2_launch
from flangeye_plugins.export.urdf import export_urdf

EXPORTS = (
    export_ros2_command,
    export_ros2_launch,
    export_urdf,
    export_moveit,
    export_easy_handeye2,
    export_opencv,
    export_ur,
    export_kuka,
    export_abb,
    export_fanuc,
    export_yaskawa,
    export_staubli,
    export_doosan,
    export_zivid,
    export_mech_mind,
    export_halcon,
    export_robodk,
    export_matrix,
)
"""The formats of the camera's pose; ``export.robot`` writes the arm, and is none of them."""
