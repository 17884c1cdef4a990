"""A calibration on its way to another program, and the file that carries it there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from flangeye.types.frames import BASE, Transform


@dataclass(frozen=True, eq=False)
class CalibratedPose:
    """What an ``export`` takes.

    Attributes:
        transform: Where the camera is in what carries it: ``base_T_camera`` or
            ``flange_T_camera``, translation in [m].
        remarks: Lines that have to stand in the file: what it is, how it was judged, and, for one
            that was refused, that it must not be used. Made printable ASCII, one line each.
        others: Of a cell of which no camera was chosen, every other transform that was found; only
            formats that declare to serve cells are given them.
    """

    transform: Transform
    remarks: tuple[str, ...] = ()
    others: tuple[Transform, ...] = ()

    def __post_init__(self) -> None:
        """Make each remark one line of ASCII, which can stand behind any comment mark."""
        object.__setattr__(self, "remarks", tuple(map(_one_line, self.remarks)))

    @property
    def each(self) -> tuple[CalibratedPose, ...]:
        """Every transform by itself."""
        return tuple(replace(self, transform=x, others=()) for x in (self.transform, *self.others))

    @property
    def stands(self) -> bool:
        """Whether the camera stands in the base, and is not carried by the arm."""
        return self.transform.parent == BASE

    def comment(self, mark: str) -> str:
        """Return the remarks as comment lines, each behind ``mark``."""
        return "".join(f"{mark} {line}\n" for line in self.remarks)


def _one_line(text: str) -> str:
    return " ".join(re.sub(r"[^ -~]", " ", text.encode("ascii", "replace").decode()).split())


@dataclass(frozen=True)
class ExportedFile:
    """What an ``export`` gives.

    Attributes:
        name: File name, without a folder.
        text: The content.
        use: One line: where it goes in the other program.
    """

    name: str
    text: str
    use: str = ""

    def __post_init__(self) -> None:
        """Refuse a name that leads out of the folder."""
        if not re.fullmatch(r"\w[\w.-]*", self.name, re.ASCII):
            raise ValueError(f"{self.name!a} is no plain file name")
