"""segment.body and fit.body: bodies of known shape at known poses, and what is refused."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flangeye.errors import RecipeError, StageError
from flangeye.models.bodies import TargetBody, load_body
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.loading import load_model
from flangeye.models.targets import Flange, plate_of
from flangeye.plugin.registry import load_registry
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    TARGET,
    Capture,
    CircleFeature,
    Earlier,
    FlangeCloud,
    Floats,
    Observation,
    PointCloud,
    PoseFeature,
    Rejected,
    Transform,
)
from flangeye.types.geometry import hat, rigid, rotation_from_rpy, rotation_log
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye_emulators.world.mesh import MATERIALS, Mesh, box, flange_mesh, wrist_mesh
from flangeye_emulators.world.raycast import RaycastScene, SolidBody
from flangeye_emulators.world.scanner import scanner_of
from flangeye_plugins.body.looks import prepared
from flangeye_plugins.body.search import BodySearch, BodyVerdict, FoundPose
from flangeye_plugins.fit.body import FitBodyParams, fit_body
from flangeye_plugins.segment.body import SegmentBodyParams, segment_body
from tools.study_bodies import SCANNER, as_made, scene, trial


@cache
def shipped(name: str) -> TargetBody:
    """A body of the project; what a search prepares of it is kept with it."""
    return load_body(name, None, Path())


GRIPPER, PASSES = shipped("gripper"), SegmentBodyParams().passed_by
DRAWN = Configuration(stands=ORIGIN)  # in the flange's frame
POSE = rigid(rotation_from_rpy(2.5, 0.6, 0.8), np.array([0.03, -0.02, 0.75]))


@cache
def eye(scanner: str = "phoxi-m", resolution: float = 0.3):
    model = load_model("scanners", scanner, Path())
    return scanner_of(model, resolution, 1.0, np.random.default_rng(0))


def scan(body: TargetBody, pose=POSE, seed: int = 0) -> Capture:
    """A simulated scan of a body before a table, with a box beside it."""
    mesh = Mesh(body.vertices, body.triangles)
    bodies = [
        SolidBody(mesh.moved(pose), MATERIALS["matt"]),
        SolidBody(box([-1, -1, 1.0], [1, 1, 1.02]), MATERIALS["table"]),
        SolidBody(box([-0.3, -0.2, 0.8], [-0.2, -0.05, 0.9]), MATERIALS["painted"]),
    ]
    xyz = eye().scan(RaycastScene(bodies), np.random.default_rng(seed))
    return Capture("0000", PointCloud(CAMERA, xyz), {FLANGE: Transform(BASE, FLANGE, pose)})


@cache
def gripper_seen() -> Capture:
    return scan(GRIPPER)


def found(
    capture: Capture, body: TargetBody = GRIPPER, earlier: tuple[Observation, ...] = ()
) -> FlangeCloud | Rejected:
    return segment_body(capture, body, DRAWN, Earlier(earlier), SegmentBodyParams())


def is_at(pose, one: FlangeCloud | Rejected) -> bool:
    assert isinstance(one, FlangeCloud), one
    assert one.camera_T_target is not None
    return np.allclose(one.camera_T_target, pose, atol=1e-3)


def sighting(pose, true=POSE) -> tuple[Observation, ...]:
    """A body that was seen at a pose while the arm had it at the true one."""
    feature = PoseFeature(Transform(CAMERA, TARGET, pose), np.eye(6) * 1e-8, {})
    return (Observation("before", feature, {FLANGE: Transform(BASE, FLANGE, true)}),)


def around(capture: Capture, start) -> FlangeCloud:
    return FlangeCloud(
        PointCloud(CAMERA, capture.cloud.points()), start[:3, 3], np.array([0, 0, -1.0]), start
    )


def off(feature: PoseFeature, pose=POSE):
    """Turn [rad] and shift [m] of a pose from the true one, in the covariance's order."""
    turn = feature.camera_T_target.rotation @ pose[:3, :3].T
    return np.r_[rotation_log(turn[None])[0], feature.camera_T_target.translation - pose[:3, 3]]


def test_a_gripper_is_found_without_a_guess_and_its_error_is_as_stated() -> None:
    feature = fit_body(found(gripper_seen()), GRIPPER, FitBodyParams())
    assert isinstance(feature, PoseFeature), feature
    error = off(feature)
    assert np.linalg.norm(error[3:]) < 0.5e-3
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert error @ np.linalg.solve(feature.covariance, error) < 22.5  # 99.9 % of 6 freedoms


def test_what_is_stated_covers_what_scanner_and_make_do() -> None:
    """The scanner's distortion and how the body is made differ from scan to scan, as stated."""
    chi = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        made = as_made(GRIPPER, rng)
        q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        pose = rigid((q := q * np.sign(np.linalg.det(q))), POSE[:3, 3] - q @ made.centre)
        xyz = scanner_of(SCANNER, 0.3, 1.0, rng).scan(
            RaycastScene(
                [SolidBody(Mesh(made.vertices, made.triangles).moved(pose), MATERIALS["matt"])]
            ),
            rng,
        )
        capture = Capture("0000", PointCloud(CAMERA, xyz), {})
        feature = fit_body(around(capture, pose), GRIPPER, FitBodyParams(), SCANNER)
        assert isinstance(feature, PoseFeature), feature
        error = off(feature, pose)
        chi.append(error @ np.linalg.solve(feature.covariance, error))
    assert 27.5 < sum(chi) < 100  # 99.9 % of 60 freedoms: 30.3 to 99.6


def slim_tool() -> TargetBody:
    """A square peg with a handle to one side, whose foot leaves a ring of the flange free."""
    parts = [
        box([-0.01, -0.01, 0.0], [0.01, 0.01, 0.14]),
        box([0.01, -0.01, 0.09], [0.06, 0.01, 0.11]),
    ]
    return TargetBody(
        "peg",
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([parts[0].triangles, parts[1].triangles + len(parts[0].vertices)]),
    )


def seen_with_flange(
    tool: TargetBody, plate: Flange, pose: Floats, aside: float, rng: np.random.Generator
) -> Capture:
    """A scan of a tool on a flange whose axis is ``aside`` of the tool's [m]."""
    made, carrier = as_made(tool, rng), pose @ rigid(np.eye(3), np.array([aside, 0.0, 0.0]))
    bodies = [
        SolidBody(Mesh(made.vertices, made.triangles).moved(pose), MATERIALS["matt"]),
        SolidBody(flange_mesh(plate).moved(carrier), MATERIALS[plate.details.finish]),
        SolidBody(wrist_mesh(plate).moved(carrier), MATERIALS["painted"]),
    ]
    xyz = scanner_of(SCANNER, 0.5, 1.0, rng).scan(RaycastScene(bodies), rng)
    return Capture("0000", PointCloud(CAMERA, xyz), {})


@pytest.mark.parametrize(("aside", "fewest", "most"), [(0.0, 4, 8), (2e-3, 0, 0)])
def test_a_flange_that_shows_beside_the_tool_counts_too(
    aside: float, fewest: int, most: int
) -> None:
    """Unless its rim is not where the tool's mesh has the flange."""
    tool, plate = slim_tool(), plate_of(load_model("robots", "ur5e", Path()))
    chi, counted = [], 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        pose = rigid(rotation_from_rpy(*rng.normal([2.6, 0.3, 0.0], 0.15)), POSE[:3, 3])
        capture = seen_with_flange(tool, plate, pose, aside, rng)
        given = (around(capture, pose), tool, FitBodyParams(), SCANNER, capture)
        both = fit_body(*given, plate, DRAWN)
        assert isinstance(both, PoseFeature)
        error = off(both, pose)
        chi.append(error @ np.linalg.solve(both.covariance, error))
        if "flange_arc" in both.figures:
            counted += 1
            # The centre is known better, and along the whole tool
            alone = fit_body(*given, None, DRAWN)
            assert isinstance(alone, PoseFeature)
            assert np.trace(both.covariance[3:, 3:]) < 0.6 * np.trace(alone.covariance[3:, 3:])
    assert fewest <= counted <= most
    assert sum(chi) < 84  # 99.9 % of 48 freedoms


def test_a_scanner_without_a_model_has_the_distortion_that_is_stated() -> None:
    capture = around(gripper_seen(), POSE)
    wide = {"model_error": "0 mm", "scanner_error": "1 mm"}
    feature = fit_body(capture, GRIPPER, FitBodyParams.model_validate(wide))
    assert isinstance(feature, PoseFeature), feature
    centre = POSE[:3, :3] @ prepared(GRIPPER).centre  # from the body's origin
    about = np.hstack([-hat(centre), np.eye(3)])  # the shift of the centre
    shift = about @ feature.covariance @ about.T
    assert np.sqrt(np.trace(shift) / 3) == pytest.approx(1e-3, rel=0.3)


HALF_TURN = rigid(rotation_from_rpy(0.0, 0.0, np.pi), np.zeros(3))
BEHIND = rigid(rotation_from_rpy(np.pi - 0.5, 0.0, 0.3), np.array([0.02, 0.01, 0.8]))
"""The gripper's cable gland, all that its half turns differ by, is behind its housing."""


def test_two_poses_that_explain_a_scan_alike_are_kept_until_the_arms_motion_tells() -> None:
    """Nothing was measured where the gland would be seen at the other half turn."""
    gland = (BEHIND @ HALF_TURN @ [0.020, 0.042, 0.040, 1.0])[:3]
    xyz = np.array(scan(GRIPPER, BEHIND).cloud.xyz)
    beside = xyz[..., :2] / xyz[..., 2:] - gland[:2] / gland[2]
    xyz[np.linalg.norm(beside, axis=-1) < 0.06] = np.nan
    capture = replace(scan(GRIPPER, BEHIND), cloud=PointCloud(CAMERA, xyz))
    both = found(capture)
    assert isinstance(both, FlangeCloud)
    assert sorted(is_at(BEHIND, one) for one in both.alone) == [False, True]
    refused = fit_body(both, GRIPPER, FitBodyParams())
    assert "2 poses of gripper explain the scan" in refused.reason
    assert is_at(BEHIND, found(capture, earlier=sighting(POSE)))
    # A pose that the arm's motion does not predict is not taken for a predicted one
    aside = BEHIND @ HALF_TURN @ rigid(rotation_from_rpy(0.0, 0.0, 0.3), np.zeros(3))
    assert len(found(capture, earlier=sighting(aside, BEHIND)).alone) == 2


def test_an_earlier_sighting_that_was_wrong_does_no_harm() -> None:
    wrong = sighting(POSE @ HALF_TURN)
    assert is_at(POSE, found(gripper_seen(), earlier=wrong))


def test_a_body_that_is_not_there_is_refused() -> None:
    absent = found(gripper_seen(), shipped("torch"))
    assert isinstance(absent, Rejected)
    assert "no pose of torch" in absent.reason


@pytest.mark.parametrize(
    ("beside", "ended", "crossing", "bounded"),
    [
        (0, 0, 0, True),  # nothing was measured around it
        (60, 0, 0, False),  # all that was measured there hides where it ends
        (60, 30, 20, True),  # the body ends before something farther
        (60, 2, 50, False),  # what is there goes on, as on the face of a box
    ],
)
def test_a_body_is_bounded_where_it_is_seen_to_end(
    beside: int, ended: int, crossing: int, bounded: bool
) -> None:
    seen = BodyVerdict(300, 250, 0, 0, beside, ended, crossing, outline=100, upon=0)
    assert seen.bounded is bounded


@pytest.mark.parametrize("seed", [73205, 73216])
def test_a_thing_that_touches_the_body_does_not_refute_it(seed: int) -> None:
    """A box that leans on the gripper's housing; another that its fingers stand on."""
    told = trial("gripper", seed)
    assert [np.linalg.norm(off(one, told.pose)[3:]) < 0.5e-3 for one in told.found] == [True]


@pytest.mark.parametrize(
    ("change", "weakest", "passes"),
    [
        ({}, 1e-3, True),
        ({"upon": 60}, 1e-3, False),  # the others are seen through, or the surface goes on
        ({"against": 120, "upon": 140}, 1e-3, False),  # a tenth of all rays
        ({"goes_on": 20}, 1e-3, False),
        ({}, 3e-3, False),  # as a chance fit may determine it
    ],
)
def test_only_what_is_seen_outside_a_body_may_be_another_thing(
    change: dict[str, int], weakest: float, passes: bool
) -> None:
    seen = BodyVerdict(1200, 1000, 60, 5, 120, 90, 20, outline=200, upon=80)
    assert PASSES(FoundPose(POSE, seen._replace(**change), weakest, 0.3)) is passes


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (np.diag([-1.0, 1.0, 1.0]), "torch is drawn mirrored"),
        (25.4 * np.eye(3), "torch is 25.4 times too large"),
        pytest.param(np.eye(3) / 10, "torch is 10 times too small", marks=pytest.mark.slow),
        pytest.param(1.3 * np.eye(3), "no pose of torch", marks=pytest.mark.slow),
    ],
    ids=["mirrored", "inches", "centimetres", "30 % too large"],
)
def test_a_model_that_is_not_the_body_is_refused(change, why) -> None:
    torch = shipped("torch")
    wrong = TargetBody("torch", np.ascontiguousarray(torch.vertices @ change), torch.triangles)
    assert why in found(scan(torch), wrong).reason


ROUND = {
    "rod": trimesh.creation.cylinder(0.03, 0.12, sections=96),
    "rod of 16 facets": trimesh.creation.cylinder(0.03, 0.12, sections=16),
    "cone": trimesh.creation.cone(0.05, 0.12, sections=64),
    "ball": trimesh.creation.icosphere(4, 0.04),
}


def round_body(name: str, place=None) -> TargetBody:
    mesh = ROUND[name].copy()
    mesh.apply_transform(np.eye(4) if place is None else place)
    return TargetBody(name, np.array(mesh.vertices), np.array(mesh.faces, np.int32))


@pytest.mark.parametrize("name", ROUND)
def test_of_a_round_body_its_axis_is_found_and_of_a_ball_its_centre(name: str) -> None:
    body = round_body(name, rigid(np.eye(3), np.array([0.0, 0.0, 0.08])))
    at = found(scan(body), body)
    assert isinstance(at, FlangeCloud), at
    axis = POSE[:3, 2]
    each: list[CircleFeature] = [fit_body(one, body, FitBodyParams()) for one in at.alone]
    assert len(each) == (2 if "rod" in name else 1)  # either end of a rod may be the upper one
    best = max(each, key=lambda one: 0.0 if one.normal is None else one.normal @ axis)
    assert best.centre_in_flange[:2] == pytest.approx([0.0, 0.0], abs=1e-6)
    error = best.centre - POSE[:3, :3] @ best.centre_in_flange - POSE[:3, 3]
    assert error @ np.linalg.solve(best.covariance, error) < 16.3  # 99.9 % of three
    if name == "ball":
        assert best.normal is None and np.sqrt(np.diag(best.covariance)).max() < 0.2e-3
    else:
        assert best.normal is not None and best.normal_covariance is not None
        slant = np.cross(best.normal, axis)
        assert slant @ np.linalg.pinv(best.normal_covariance) @ slant < 13.8  # of two
        assert np.sqrt(np.trace(best.normal_covariance)) < np.radians(0.5)


@pytest.mark.parametrize("name", ["rod", "cone", "ball"])
def test_the_axis_of_a_round_body_is_that_of_its_mesh(name: str) -> None:
    place = rigid(rotation_from_rpy(0.4, -0.9, 0.0), np.array([0.1, -0.05, 0.2]))
    freedoms, centre, axis = prepared(round_body(name, place)).symmetry
    assert freedoms == (3 if name == "ball" else 5)
    away = centre - place[:3, 3]
    if name == "ball":
        assert away == pytest.approx(np.zeros(3), abs=1e-4)
    else:
        assert abs(axis @ place[:3, 2]) == pytest.approx(1.0, abs=1e-6)
        assert np.cross(away, place[:3, 2]) == pytest.approx(np.zeros(3), abs=1e-4)
    assert prepared(GRIPPER).symmetry.freedoms == 6


def test_a_round_body_is_drawn_along_z_where_its_place_is_known() -> None:
    body = round_body("cone", rigid(rotation_from_rpy(0.0, np.pi / 2, 0.0), np.zeros(3)))
    with pytest.raises(StageError, match=r"axis is along \(1\.00, .*draw it with the axis along z"):
        found(scan(body), body)


def test_a_body_whose_half_turn_looks_the_same_has_several_poses() -> None:
    mesh = trimesh.creation.box((0.16, 0.1, 0.05))
    block = TargetBody("block", np.array(mesh.vertices), np.array(mesh.faces, np.int32))
    assert len(found(scan(block), block).alone) > 1


def test_a_part_that_moves_is_seen_in_what_the_scan_is_off() -> None:
    """Fingers 20 mm further open than their mesh: the fit stays with what did not move."""
    moved = GRIPPER.vertices.copy()
    finger = moved[:, 2] > 0.107
    moved[finger, 0] += np.where(moved[finger, 0] > 0, 0.01, -0.01)
    other = TargetBody("open", moved, GRIPPER.triangles)
    feature = fit_body(around(scan(other), POSE), GRIPPER, FitBodyParams())
    assert isinstance(feature, PoseFeature), feature
    assert np.linalg.norm(off(feature)[3:]) < 2e-3


@pytest.mark.parametrize("further", [0.01, pytest.param(-0.008, marks=pytest.mark.slow)])
def test_a_part_that_stands_elsewhere_is_named(further: float) -> None:
    moved = GRIPPER.vertices.copy()
    jaws = (moved[:, 2] > 0.1055) & (np.abs(moved[:, 0]) < 0.04)
    moved[jaws, 0] += np.where(moved[jaws, 0] > 0, further, -further)
    pose = rigid(rotation_from_rpy(2.2, 0.1, -0.9), np.array([0.0, 0.05, 0.8]))
    refused = found(scan(TargetBody("open", moved, GRIPPER.triangles), pose))
    assert isinstance(refused, Rejected)
    assert "a part of it is not where its mesh has it" in refused.reason
    assert "z 106 to 168 mm" in refused.figures
    assert "as it was in the session" in refused.fix


def test_fit_body_needs_segment_body() -> None:
    cloud = FlangeCloud(gripper_seen().cloud, np.zeros(3), np.array([0, 0, -1.0]))
    assert "segment.body" in fit_body(cloud, GRIPPER, FitBodyParams()).reason


def test_the_unit_is_judged_by_the_size_and_refused_where_it_cannot_be(tmp_path: Path) -> None:
    def written(scale):
        mesh = trimesh.Trimesh(GRIPPER.vertices * scale, GRIPPER.triangles, process=False)
        mesh.export(tmp_path / "own.stl")

    written(1e3)
    judged = load_body("own.stl", None, tmp_path)
    assert judged.size == pytest.approx(GRIPPER.size, rel=1e-5)
    assert "unit: mm is assumed" in judged.note
    assert load_body("own.stl", "mm", tmp_path).note == ""
    with pytest.raises(
        RecipeError, match="5.716 m across with unit: in, and .* 225 mm with unit: mm"
    ):
        load_body("own.stl", "in", tmp_path)
    written(1 / 0.0254)
    inches = load_body("own.stl", None, tmp_path)
    assert inches.size == pytest.approx(GRIPPER.size, rel=1e-5)
    assert "unit: in is assumed" in inches.note
    written(1e5)
    with pytest.raises(RecipeError, match="2.25e.04 across, .* no known unit gives such a size"):
        load_body("own.stl", None, tmp_path)
    with pytest.raises(RecipeError, match=r"no body 'griper'; known: gripper"):
        load_body("griper", None, tmp_path)


def test_a_body_survives_being_carried_with_a_run(tmp_path: Path) -> None:
    (tmp_path / "body.ply").write_text(GRIPPER.as_ply())
    again = load_body("body.ply", "m", tmp_path)
    assert np.abs(again.vertices - GRIPPER.vertices).max() < 1e-7
    assert (again.triangles == GRIPPER.triangles).all()


def test_a_gltf_file_is_read_with_its_buffers_which_lie_beside_it(tmp_path: Path) -> None:
    mesh = trimesh.Trimesh(GRIPPER.vertices, GRIPPER.triangles, process=False)
    for inside in (True, False):
        files = trimesh.exchange.gltf.export_gltf(
            mesh.scene(), embed_buffers=inside, merge_buffers=True
        )
        for name, content in files.items():
            (tmp_path / name).write_bytes(content)
        body = load_body("model.gltf", None, tmp_path)
        assert body.size == pytest.approx(GRIPPER.size, rel=1e-6)
        assert body.note == ""  # glTF is in metres
    (buffer,) = {*files} - {"model.gltf"}
    text = (tmp_path / "model.gltf").read_text()
    (tmp_path / "model.gltf").write_text(text.replace(buffer, f"../{buffer}"))
    with pytest.raises(RecipeError, match=r"buffer \.\./.* is not a file in its own folder"):
        load_body("model.gltf", None, tmp_path)
    (tmp_path / "model.gltf").write_text(text)
    (tmp_path / buffer).unlink()
    with pytest.raises(RecipeError, match=f"{buffer}: cannot be read"):
        load_body("model.gltf", None, tmp_path)


RECIPE = "title: T\nrobot: ur5\nscanner: phoxi-m\n{}steps: [acquire.simulated, segment.body, fit.body, solve.robust]\n"


@pytest.mark.parametrize(
    ("sections", "target", "place"),
    [
        ("target: gripper\n", "flange", "known"),
        ("target: {body: gripper, at: unknown}\n", "flange", "unknown"),
        ("target: {body: gripper, at: link5}\n", "link5", "known"),
        (
            "configuration: {name: eye-on-arm, camera: link3}\ntarget: {body: gripper, at: base}\n",
            "base",
            "known",
        ),
    ],
)
def test_a_recipe_says_where_the_body_is_drawn(sections, target, place) -> None:
    text = RECIPE.format(sections).replace("acquire.simulated", "{acquire.archive: {path: a}}")
    recipe = parse_recipe(text, "r", load_registry())
    configuration = recipe.context[Configuration]
    assert configuration.target == target
    assert (configuration.place is None) == (place == "unknown")
    assert recipe.context[TargetBody].name == "gripper"


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ("", "needs a body to look for"),
        (
            "target: {body: gripper, at: base}\n",
            "target: {at: …} is flange, link1, link2, … or unknown, not base; a body on the base "
            "needs a camera on the arm",
        ),
        (
            "target: {body: gripper, at: link7}\n",
            "the target is carried by a link, link1 to link6, not by link7; write for example "
            "at: link3",
        ),
        (
            "target: {body: gripper, at: link5}\n",
            "acquire.simulated plans poses that show a body on the flange, and this one is on link5",
        ),
        (
            "configuration: {place: unknown}\ntarget: gripper\n",
            "states a body's place; remove place:",
        ),
    ],
)
def test_a_recipe_that_contradicts_itself_is_refused(sections, message) -> None:
    with pytest.raises(RecipeError, match=re.escape(message)):
        parse_recipe(RECIPE.format(sections), "r", load_registry())


def test_a_mesh_of_ones_own_goes_with_the_run(tmp_path: Path) -> None:
    (tmp_path / "own.ply").write_text(GRIPPER.as_ply())
    (tmp_path / "r.yaml").write_text(RECIPE.format("target: own.ply\n"))
    recipe = load_recipe(tmp_path / "r.yaml", load_registry())
    for name, text in recipe.files.items():
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text(text)
    (tmp_path / "own.ply").unlink()
    again = load_recipe(tmp_path / "run" / "recipe.resolved.yaml", load_registry())
    assert again.context[TargetBody].digest == recipe.context[TargetBody].digest


def test_a_scan_too_coarse_for_a_body_says_so() -> None:
    """Of a gripper seen end on, whose length hardly shows, and not that its mesh is wrong."""
    far = rigid(rotation_from_rpy(3.1, 0.0, 0.0), np.array([0.03, -0.02, 1.35]))
    gripper = SolidBody(Mesh(GRIPPER.vertices, GRIPPER.triangles).moved(far), MATERIALS["matt"])
    wall = SolidBody(box([-1, -1, 1.65], [1, 1, 1.67]), MATERIALS["table"])
    xyz = eye("azure-kinect", 1.0).scan(RaycastScene([gripper, wall]), np.random.default_rng(0))
    refused = found(Capture("0000", PointCloud(CAMERA, xyz), {}))
    assert isinstance(refused, Rejected)
    assert "leaves its pose or size too uncertain: show more of it" in refused.reason


def test_a_fit_that_rests_on_other_edges_is_refused() -> None:
    """A plate's dome says where it is, and the ends of the plate are 2 mm aside of there."""

    def domed(aside: float) -> TargetBody:
        dome = trimesh.creation.icosphere(4, 0.03)
        plate = trimesh.creation.box((0.14, 0.1, 0.003)).apply_translation([aside, 0.0, 0.0])
        faces = np.concatenate([dome.faces, plate.faces + len(dome.vertices)])
        return TargetBody("dome", np.concatenate([dome.vertices, plate.vertices]), faces)

    told = fit_body(around(scan(domed(2e-3)), POSE), domed(0.0), FitBodyParams(), SCANNER)
    assert isinstance(told, Rejected), told
    assert "the fit used edges of another object" in told.reason
    aligned = fit_body(around(scan(domed(0.0)), POSE), domed(0.0), FitBodyParams(), SCANNER)
    assert isinstance(aligned, PoseFeature), aligned


def test_the_carrier_right_behind_the_mounting_face_is_not_taken_for_it() -> None:
    """Seen from behind, the plate's foot is where the flange's wall goes on with its radius."""
    told = trial("ring-plate", 81073)
    assert [np.linalg.norm(off(one, told.pose)[3:]) < 0.6e-3 for one in told.found] == [True]


@pytest.mark.parametrize("seed", [81009, 81033, 94044, 97167])
def test_a_thin_body_is_found_beside_things_that_fit_its_face(seed: int) -> None:
    """Seen nearly edge on, where many poses lay its broad face on the table or on a box."""
    told = trial("ring-plate", seed)
    assert [np.linalg.norm(off(one, told.pose)[3:]) < 1e-3 for one in told.found] == [True]


def test_a_steep_face_that_goes_on_is_no_end_of_a_body() -> None:
    """Beyond the plate's end it is farther from the scanner, like a background."""
    assert trial("ring-plate", 98090).found == []


def test_half_of_a_body_without_any_end_is_not_enough() -> None:
    """A box's face before a void shows half of the plate, which is not there."""
    assert trial("ring-plate", 101280).found == []


def test_a_background_that_crosses_the_plane_of_a_face_is_no_part_of_it() -> None:
    told = trial("ring-plate", 97016)
    assert [np.linalg.norm(off(one, told.pose)[3:]) < 0.3e-3 for one in told.found] == [True]


@pytest.mark.parametrize(("scale", "why"), [(1.01, "smaller"), (1 / 1.01, "larger")])
def test_a_mesh_of_another_size_is_refused_by_what_the_scan_shows(scale: float, why: str) -> None:
    other = TargetBody("gripper", GRIPPER.vertices * scale, GRIPPER.triangles)
    refused = fit_body(around(gripper_seen(), POSE), other, FitBodyParams(), SCANNER)
    assert isinstance(refused, Rejected)
    assert "in another size than its mesh" in refused.reason
    figure = re.match(rf"{why} by at least (\S+)%", refused.figures)
    assert figure
    assert 0.3 < float(figure[1]) <= 1.0


def test_where_the_carrier_goes_on_beyond_a_bodys_foot_is_no_end_of_it() -> None:
    """The flange is flush with the torch's bracket: its edges are not those of the bracket."""
    told = trial("torch", 84004)
    assert [np.linalg.norm(off(one, told.pose)[3:]) < 0.5e-3 for one in told.found] == [True]


def among_others(name, seed):
    """A scan of a body among other things, the body, and its pose."""
    rng = np.random.default_rng(seed)
    body = shipped(name)
    bodies, pose = scene(rng, as_made(body, rng))
    xyz = scanner_of(SCANNER, 0.35, 1.0, rng).scan(RaycastScene(bodies), rng)
    return Capture("0000", PointCloud(CAMERA, xyz), {}), body, pose


def test_a_mirrored_mesh_that_a_half_turn_hides_is_refused_by_what_its_image_explains_more() -> (
    None
):
    """Turned over, a mirrored plate has the plate's outline; a side of it has a detail more."""
    capture, plate, _ = among_others("ring-plate", 770005)
    mirrored = TargetBody("ring-plate", plate.vertices * [-1, 1, 1], plate.triangles)
    refused = found(capture, mirrored)
    assert isinstance(refused, Rejected)
    assert "drawn mirrored: its mirror image fits the scan better" in refused.reason
    assert "mirror the mesh" in refused.fix
    assert isinstance(found(capture, plate), FlangeCloud)


def test_a_mirrored_meshs_image_is_found_where_a_detail_moves_its_centre() -> None:
    """The gripper's gland, which stands out of the mirrored mesh's face, is no other thing."""
    assert "its mirror image fits the scan better" in trial("gripper", 74021).why


def test_of_two_poses_the_one_that_explains_a_patch_more_is_taken_alone() -> None:
    capture, plate, pose = among_others("ring-plate", 780060)
    points, looks = capture.cloud.points(), prepared(plate)
    search = BodySearch(points, looks, PASSES)
    turned = [pose, *looks.twins(pose)]
    passing = [one for one in search.near(np.array(turned)) if PASSES(one)]
    assert len(passing) == 2
    kept = search.unrivalled(passing, passing)
    assert [np.linalg.norm((one.pose - pose)[:3, 3]) < 1e-3 for one in kept] == [True]
    assert search.unrivalled(passing, []) == passing


def test_a_twin_that_fails_narrowly_leaves_a_pose_open() -> None:
    """The gripper turned by half a turn passes; its true pose shows as much, and too few ends."""
    capture, gripper, pose = among_others("gripper", 772011)
    both = found(capture, gripper)
    assert isinstance(both, FlangeCloud)
    turned = [np.linalg.norm((one.camera_T_target - pose)[:3, :3]) for one in both.alone]
    assert sorted(turn < 0.02 for turn in turned) == [False, True]
