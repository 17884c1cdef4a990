"""The conformance kit: what every plugin of a kind must do, as tests a vendor inherits.

``class TestMyFit(FitConformance): stage = my_fit`` in a test module is all that pytest needs; it
then runs every ``test_…`` method of the class. Nothing here imports pytest: a method that finds a
fault raises AssertionError with one line that says what was expected.
"""

from flangeye.testing.afterwards import CheckConformance, GuideConformance, ReplayConformance
from flangeye.testing.base import Conformance
from flangeye.testing.costs import CostConformance, ErrorConformance
from flangeye.testing.devices import (
    ArcConformance,
    ProfilerConformance,
    RobotConformance,
    ScannerConformance,
    SensorConformance,
)
from flangeye.testing.exporting import ExportConformance
from flangeye.testing.percapture import FitConformance, SegmentConformance
from flangeye.testing.solving import RefineConformance, SolveConformance, VerifyConformance
from flangeye.testing.sources import (
    AcquireConformance,
    PlanConformance,
    ReaderConformance,
    ViewConformance,
)
from flangeye.testing.welding import (
    ControllerConformance,
    ScanConformance,
    SeamConformance,
    WeldConformance,
)

KITS = {
    "acquire": AcquireConformance,
    "segment": SegmentConformance,
    "fit": FitConformance,
    "solve": SolveConformance,
    "refine": RefineConformance,
    "verify": VerifyConformance,
    "export": ExportConformance,
    "scan": ScanConformance,
    "seam": SeamConformance,
    "weld": WeldConformance,
    "reader": ReaderConformance,
    "plan": PlanConformance,
    "view": ViewConformance,
    "cost": CostConformance,
    "error": ErrorConformance,
    "robot": RobotConformance,
    "scanner": ScannerConformance,
    "controller": ControllerConformance,
    "sensor": SensorConformance,
    "profiler": ProfilerConformance,
    "arc": ArcConformance,
    "replay": ReplayConformance,
    "guide": GuideConformance,
    "check": CheckConformance,
}
"""Kind of stage or part -> its class."""

# Spelt out: a type checker takes nothing else for public.
__all__ = [
    "KITS",
    "AcquireConformance",
    "ArcConformance",
    "CheckConformance",
    "Conformance",
    "ControllerConformance",
    "CostConformance",
    "ErrorConformance",
    "ExportConformance",
    "FitConformance",
    "GuideConformance",
    "PlanConformance",
    "ProfilerConformance",
    "ReaderConformance",
    "RefineConformance",
    "ReplayConformance",
    "RobotConformance",
    "ScanConformance",
    "ScannerConformance",
    "SeamConformance",
    "SegmentConformance",
    "SensorConformance",
    "SolveConformance",
    "VerifyConformance",
    "ViewConformance",
    "WeldConformance",
]
