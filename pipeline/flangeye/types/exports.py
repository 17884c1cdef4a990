"""A calibration on its way to another program, and the file that carries it there."""

from __future__ import annotations

from dataclasses import dataclass, replace

from flangeye.types.frames import BASE, Transform


@dataclass(frozen=True, eq=False)
class CalibratedPose:
    """What an ``export`` takes.

    Attributes:
        transform: Where the camera is in what carries it: ``base_T_camera`` or
            ``flange_T_camera``, translation in [m].
        remarks: Lines that have to stand in the file: what it is, how it was judged, and, for one
            that was refused, that it must not be used. ASCII, no line breaks.
        others: Of a cell of which no camera was chosen, every other transform that was found; only
            formats that declare to serve cells are given them.
    """

    transform: Transform
    remarks: tuple[str, ...] = ()
    others: tuple[Transform, ...] = ()

    @property
    def each(self) -> tuple[CalibratedPose, ...]:
        """Every transform by itself."""
        return tuple(replace(self, transform=x, others=()) for x in (self.transform, *self.others))

    @property
    def stands(self) -> bool:
        """Whether the camera stands in the base, and is not carried by the arm."""
        return self.transform.parent == BASE

    def comment(self, mark: str, end: str = "") -> str:
        """Return the remarks as comment lines, each between ``mark`` and ``end``."""
        return "".join(f"{mark} {line}{end}\n" for line in self.remarks)


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
