# mypy: ignore-errors
"""tf2_msgs for the tests: built with the wheels' own generators, as no wheel has it.

The one line of its definition is public; what colcon does with it is done here with a compiler. Run
under the Python that has the wheels: python tf2.py INTO.
"""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"

FORWARD = """
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_typesupport_interface/macros.h"
#define HANDLE(kind) ROSIDL_TYPESUPPORT_INTERFACE__MESSAGE_SYMBOL_NAME(kind, tf2_msgs, msg, TFMessage)
const rosidl_message_type_support_t * HANDLE(rosidl_typesupport_fastrtps_c)(void);
const rosidl_message_type_support_t * HANDLE(rosidl_typesupport_c)(void)
{ return HANDLE(rosidl_typesupport_fastrtps_c)(); }
"""
"""The one type support there is, under the name of any."""

LIBRARIES = [
    *(
        f"{package}__rosidl_{kind}"
        for package in ("geometry_msgs", "std_msgs", "builtin_interfaces")
        for kind in ("generator_c", "typesupport_fastrtps_c", "typesupport_c")
    ),
    "geometry_msgs__rosidl_generator_py", "rosidl_runtime_c", "rosidl_typesupport_fastrtps_c",
    "fastcdr",
]  # fmt: skip


def generate(into):
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport

    (into / "msg").mkdir(parents=True)
    (into / "msg" / "TFMessage.msg").write_text(DEFINITION)
    convert_msg_to_idl(into, "tf2_msgs", Path("msg/TFMessage.msg"), into / "msg")
    for generator in (
        GenerateC("c"), GenerateFastRTPSCTypesupport("f"),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
    ):  # fmt: skip
        generator.generate("tf2_msgs", [f"{into}:msg/TFMessage.idl"], [f"{sys.prefix}/share"], into)
    (into / "__init__.py").touch()
    (into / "forward.c").write_text(FORWARD)


def compile_all(into):
    import numpy

    headers = Path(sys.prefix) / "include"
    folders = [into.parent, headers, *headers.iterdir(), sysconfig.get_path("include"),
               numpy.get_include()]  # fmt: skip
    includes = [f"-I{folder}" for folder in folders]
    for source in [*into.rglob("*.c"), *into.rglob("*.cpp")]:
        compiler = "g++" if source.suffix == ".cpp" else "gcc"
        subprocess.run(
            [compiler, "-fPIC", "-w", "-c", *includes, source, "-o", f"{source}.o"], check=True
        )
    name = f"tf2_msgs_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    libraries = [f"-L{sys.prefix}/lib", *(f"-l{name}" for name in LIBRARIES)]
    subprocess.run(
        ["g++", "-shared", *into.rglob("*.o"), "-o", into / name, *libraries], check=True
    )


if __name__ == "__main__":
    os.environ["AMENT_PREFIX_PATH"] = sys.prefix
    generate(Path(sys.argv[1]) / "tf2_msgs")
    compile_all(Path(sys.argv[1]) / "tf2_msgs")
