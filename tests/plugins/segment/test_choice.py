"""Which disc is taken for the flange among others, and what is said when none is."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.errors import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import flange_of, load_standard, wrist_circle_of
from flangeye.types import FlangeCloud, Rejected
from flangeye_plugins.segment.flange import SegmentParams, segment_flange
from tests.plugins.fixed import fixed
from tests.plugins.segment.scenes import ASIDE, CENTRE, Scene, capture, towards_scanner

UR5 = flange_of(load_model("robots", "ur5").flange, load_standard("50-4-M6"))
UR10 = flange_of(load_model("robots", "ur10e").flange, load_standard("50-4-M6"))


assert UR5.bore is not None
BORE = UR5.bore


def found(xyz, flange=UR5, **params) -> FlangeCloud:
    cloud = segment_flange(capture(xyz), flange, fixed(SegmentParams, **params))
    assert isinstance(cloud, FlangeCloud), cloud
    return cloud


def reason(xyz, flange=UR5, **params) -> str:
    rejected = segment_flange(capture(xyz), flange, fixed(SegmentParams, **params))
    assert isinstance(rejected, Rejected), rejected
    return rejected.reason


def off(cloud: FlangeCloud, centre=CENTRE) -> float:
    return float(np.linalg.norm(cloud.centre - centre))


@settings(max_examples=10)
@given(
    x=st.floats(-0.1, 0.1), y=st.floats(-0.06, 0.06), z=st.floats(0.5, 0.75),
    tilt=st.floats(-0.7, 0.7),
)  # fmt: skip
def test_it_is_found_wherever_it_is(x: float, y: float, z: float, tilt: float) -> None:
    centre = np.array([x, y, z])
    normal = towards_scanner(centre, tilt)
    cloud = found(Scene().table().flange(UR5, centre, normal).scan())
    assert off(cloud, centre) < 1.5e-3
    assert cloud.normal @ normal > np.cos(np.radians(0.3))


@pytest.mark.parametrize("missing", [0.1, 0.25])
def test_missing_points_do_not_hide_it(missing: float) -> None:
    assert off(found(Scene().table().flange(UR5).scan(missing=missing))) < 1.5e-3


def test_the_order_of_loose_points_does_not_matter() -> None:
    points = Scene().table().flange(UR5).scan(missing=0.1).reshape(-1, 3)
    shuffled = np.random.default_rng(0).permutation(points)
    first, second = found(points), found(shuffled)
    assert first.centre == pytest.approx(second.centre, abs=1e-5)
    assert len(first.cloud.xyz) == pytest.approx(len(second.cloud.xyz), rel=1e-3)


def test_full_resolution_is_kept_on_the_disc_only() -> None:
    xyz = Scene(columns=1200, rows=900, pitch=0.35e-3).table().flange(UR5).scan()
    cloud = found(xyz)
    area = np.pi * (UR5.rim**2 - BORE**2) * np.cos(0.3)
    assert len(cloud.cloud.xyz) > 0.8 * area / 0.35e-3**2
    assert np.linalg.norm(cloud.cloud.xyz - cloud.centre, axis=1).max() < UR5.outer + 4e-3


@pytest.mark.parametrize(
    ("inner", "outer"),
    [(0.0, 31.5), (16.0, 40.0), (8.0, 31.0), (BORE * 1e3, UR5.rim * 1e3)],
    ids=["blind", "large", "narrow bore", "without holes"],
)
def test_another_disc_is_not_taken_for_it(inner: Any, outer: Any) -> None:
    scene = Scene().table().flange(UR5).ring(inner * 1e-3, outer * 1e-3)
    assert off(found(scene.scan())) < 1.5e-3


def test_two_flanges_are_one_too_many() -> None:
    said = reason(Scene().table().flange(UR5).flange(UR5, ASIDE).scan())
    assert said.startswith("2 discs look like the flange: at (")
    assert said.endswith(") mm; hide all but one, or narrow near and far")


def test_the_wrist_of_a_wrist_circle_carries_a_plate() -> None:
    wrist = wrist_circle_of(load_model("robots", "ur10e").flange, 0.09)
    scene = Scene().table().flange(UR10).ring(0.0, 0.045)
    behind = CENTRE - UR10.details.thickness * towards_scanner()
    assert off(found(scene.scan(), wrist), behind) < 2e-3


def test_says_what_is_wrong_with_a_blank_disc() -> None:
    said = reason(Scene().table().ring(UR5.bore, UR5.rim).scan())
    assert said == "a disc 57 mm across with a bore has no threaded holes"


def test_says_that_there_is_no_bore() -> None:
    said = reason(Scene().table().ring(0.0, UR5.rim).scan())
    assert said == "a disc 57 mm across has 0% of a bore of 33.0 mm, at least 30% is needed"


def test_says_how_steeply_it_is_seen() -> None:
    xyz = Scene().table().flange(UR5, normal=towards_scanner(tilt=0.6)).scan()
    assert reason(xyz, max_incidence=np.radians(30)) == "incidence 34 deg over the limit of 30 deg"


def test_says_what_size_there_is() -> None:
    xyz = Scene().table().ring(0.0, 0.106).scan()
    said = reason(xyz)
    assert said == ("no plane of the flange's size: nearest candidate 208 mm across, flange 61 mm")


def test_says_that_there_is_nothing_flat() -> None:
    xyz = Scene().table().scan()
    assert reason(xyz[::80, ::80]) == "no flat surface in sight"


def test_a_grid_without_neighbours_is_still_a_scan() -> None:
    xyz = Scene(columns=800, rows=600, pitch=0.5e-3).table().flange(UR5).scan()
    scattered = np.full_like(xyz, np.nan)
    scattered[::2, ::2] = xyz[::2, ::2]
    assert off(found(scattered)) < 2e-3


def test_says_that_nothing_is_there() -> None:
    nothing = np.full((40, 50, 3), np.nan, dtype=np.float32)
    assert reason(nothing) == "no finite point"
    assert reason(nothing.reshape(-1, 3)) == "no finite point"
    assert reason(np.zeros((0, 3), dtype=np.float32)) == "no finite point"


def test_says_what_lies_between_near_and_far() -> None:
    xyz = Scene(40, 30).plane(np.array([0, 0, 0.9]), np.array([0, 0, -1.0])).scan(noise=0.0)
    assert reason(xyz, near="100 mm", far="800 mm") == (
        "no point between near 100 mm and far 800 mm: depths from 900 to 900 mm"
    )


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (
            1e3,
            "capture '0007': half of the points are 900 m away; looks like millimetres read as "
            "metres: state unit mm where the clouds are read",
        ),
        (
            1e-3,
            "capture '0007': half of the points are 0.0009 m away; looks like metres read as "
            "millimetres: state unit m where the clouds are read",
        ),
    ],
)
def test_a_wrong_unit_stops_the_run(scale: float, said: str) -> None:
    xyz = Scene(40, 30).plane(np.array([0, 0, 0.9]), np.array([0, 0, -1.0])).scan(noise=0.0)
    with pytest.raises(StageError) as stopped:
        segment_flange(capture((scale * xyz).astype(np.float32)), UR5, SegmentParams())
    assert str(stopped.value) == said
