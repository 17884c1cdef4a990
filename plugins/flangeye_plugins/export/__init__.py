"""``export.*``: the camera pose as another program takes it. Add a format: a new module here."""

from flangeye_plugins.export.abb import export_abb
from flangeye_plugins.export.doosan import export_doosan
from flangeye_plugins.export.easy_handeye2 import export_easy_handeye2
from flangeye_plugins.export.fanuc import export_fanuc
from flangeye_plugins.export.halcon import export_halcon
from flangeye_plugins.export.kuka import export_kuka
from flangeye_plugins.export.matrix import export_matrix
from flangeye_plugins.export.mech_mind import export_mech_mind
from flangeye_plugins.export.moveit import export_moveit
from flangeye_plugins.export.opencv import export_opencv
from flangeye_plugins.export.robodk import export_robodk
from flangeye_plugins.export.ros2 import export_ros2_command, export_ros2_launch
from flangeye_plugins.export.staubli import export_staubli
from flangeye_plugins.export.universal_robots import export_ur
from flangeye_plugins.export.urdf import export_urdf
from flangeye_plugins.export.yaskawa import export_yaskawa
from flangeye_plugins.export.zivid import export_zivid

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
