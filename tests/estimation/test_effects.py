"""What errors of a cell are assumed, how large, and how each of them moves what is seen.

The sizes stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.effects.arm import arm_scatters, displacements
from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.effects.scanner import DistortionField
from flangeye.estimation.effects.target import offset_shown_to, wrong_offset
from flangeye.estimation.graph import Carrier, Problem, Sightings
from flangeye.estimation.session.session import ModelOptions, effects_of
from flangeye.models.cell import Frame
from flangeye.models.loading import load_model
from flangeye.types import Floats
from flangeye.types.geometry import kabsch, rigid, rotation_exp, rotation_log
from tests.estimation.sessions import robot

MODEL, ARM = robot("ur5e")
HOME = np.array([0.3, -1.5, 1.4, -1.2, -1.5, 0.2])
PLACES = {
    "camera": rigid(rotation_exp([2.0, 0.5, -1.0]), [0.6, 0.1, 0.9]),
    "target": rigid(rotation_exp([0.3, -0.2, 1.0]), [0.05, 0.0, 0.1]),
}
STEP = 1e-6


def problem_of(rank: int = 6, n: int = 12, told: bool = True, mounted: bool = False) -> Problem:
    """Return a problem whose sightings are exact.

    Args:
        rank: Of each sighting: 6 for a marker, 5 for a circle with its normal, 3 for a centre.
        n: How many.
        told: Whether the arm's joints and accuracy are.
        mounted: Whether the target's place on the flange is.
    """
    rng = np.random.default_rng(3)
    joints = HOME + rng.uniform(-0.4, 0.4, (n, 6))
    frames = {
        "flange": Frame("base", ARM.flange(joints)),
        "camera": Frame("base"),
        "target": Frame("flange", PLACES["target"] if mounted else None),
    }
    carrier = Carrier("flange", "flange", ARM, joints, 2e-4) if told else Carrier("flange", "arm")
    projectors = np.tile(np.diag([float(rank > 3)] * 3 + [1.0] * 3), (n, 1, 1))
    seen = Sightings(
        np.arange(n), np.zeros(n, dtype=np.intp), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)),
        1e-8 * np.tile(np.eye(6), (n, 1, 1)), projectors, np.zeros((n, 3)), np.full(n, rank < 6),
        np.zeros((n, 6, 0)),
    )  # fmt: skip
    return exact(Problem(frames, [("camera", "target")], seen, [carrier]), rank)


def exact(problem: Problem, rank: int) -> Problem:
    """Return a problem whose sightings are where they are predicted, with normals of a rank of 5."""
    linear, seen = problem.linearised(PLACES), problem.seen
    projectors = seen.projectors.copy()
    if rank == 5:
        axes = linear.turns[:, :, 2]
        projectors[:, :3, :3] = np.eye(3) - axes[:, :, None] * axes[:, None]
    centres = seen.centres - linear.residuals[:, 3:]
    seen = replace(seen, rotations=linear.turns, centres=centres, projectors=projectors)
    return replace(problem, seen=seen)


def effects(problem: Problem, **asked: Any) -> list[Effect]:
    return effects_of(problem, None, ModelOptions(**asked))


def named(problem: Problem, name: str, **asked: Any) -> Effect:
    (found,) = (e for e in effects(problem, **asked) if e.name == name)
    return found


def block(problem: Problem, name: str) -> Floats:
    """Return the derivatives of what is seen, (N, 6, K), in the directions that are measured."""
    found = named(problem, name).block(problem, problem.linearised(PLACES))
    return np.asarray(problem.seen.projectors @ found)


def seen_from(problem: Problem, frames: dict[str, Floats]) -> Floats:
    """Return (N, 6) how what is seen changes by a step that moves frames, for a unit of it."""
    there = {n: replace(problem.frames[n], place=place) for n, place in frames.items()}
    moved = replace(problem, frames={**problem.frames, **there})
    return -moved.residuals(PLACES) / STEP


# --- sizes ----------------------------------------------------------------------------------------

DRIFT = [("drift of camera", 20e-6, 4.0, "", False, False, False)] * 2


def assumed(found: Sequence[Effect]) -> list[Any]:
    return [
        (e.name, pytest.approx(e.size), e.factor, e.cause, e.of_arm, e.lasting, e.of_camera)
        for e in found
    ]


def test_of_an_arm_whose_joints_are_known_each_kind_has_its_share_of_the_joints_accuracy() -> None:
    told = assumed(effects(problem_of()))
    assert told == [
        ("joint zeros", 2e-4, 1.8, "flange", True, True, False),
        ("encoder eccentricity", 0.4e-4, 1.8, "flange", True, True, False),
        ("sag", 2e-4, 1.8, "flange", True, True, False),
        ("link lengths", 0.3e-4, 1.8, "flange", True, True, False),
        ("link twists", 0.6e-4, 1.8, "flange", True, True, False),
        ("backlash", 0.1e-4, 1.8, "flange", False, True, False),
        ("smooth error", 0.2e-4, 4.0, "flange", True, True, False),
        ("size of target", 1e-3, 2.0, "", False, True, False),
        ("focal length of camera", 1e-3, 2.0, "", False, True, True),
        *DRIFT,
    ]


def test_of_an_arm_whose_joints_are_unknown_the_base_and_the_flange_are_off() -> None:
    told = assumed(effects(problem_of(3, told=False)))
    assert told == [
        ("place of the base", 0.3e-3, 1.8, "arm", True, True, False),
        ("place of the base", 0.15e-3, 1.8, "arm", True, True, False),
        ("place of the flange", 0.36e-3, 1.8, "arm", True, True, False),
        ("place of the flange", 0.045e-3, 1.8, "arm", True, True, False),
        ("error linear in the pose", 0.3e-3, 1.8, "arm", True, True, False),
        ("smooth error", 0.03e-3, 4.0, "arm", True, True, False),
        *DRIFT,
    ]


def test_the_noise_from_pose_to_pose_is_of_the_joints_or_what_they_would_tell() -> None:
    def told(problem: Problem) -> list[Any]:
        return [(pytest.approx(s.size), s.factor) for s in arm_scatters(problem)]

    assert told(problem_of()) == [(2e-5, 4.0)]
    assert told(problem_of(told=False)) == [(0.12e-3, 4.0), (0.03e-3, 4.0)]


def test_a_joint_lags_behind_the_direction_in_which_it_last_moved() -> None:
    problem = problem_of(n=5)
    (carrier,) = problem.carriers
    joints = np.array(carrier.joints)
    # The first joint moves up, rests but for what it reports, and comes back
    joints[:, 0] = joints[0, 0] + np.array([0.0, 0.2, 0.20002, 0.19999, 0.1])
    carrier = replace(carrier, joints=joints)
    problem = replace(problem, carriers=[carrier])
    (lag,) = (e for e in effects(problem) if e.name == "backlash")
    linear = problem.linearised(PLACES)
    found = lag.block(problem, linear)[..., 0]
    moves = (linear.blocks["flange"] @ displacements(carrier)["zeros"][problem.seen.times])[..., 0]
    sides = np.array([0.0, 1.0, 1.0, 1.0, -1.0])[problem.seen.times]
    np.testing.assert_allclose(found, moves * sides[:, None], atol=1e-15)


@pytest.mark.parametrize(("rank", "told"), [(6, []), (5, ["tilt", "offset"]), (3, ["offset"])])
def test_a_circle_that_is_mounted_somewhere_is_tilted_and_off(rank: int, told: list[str]) -> None:
    sizes = {"tilt": (0.5e-3, 2.0), "offset": (0.03e-3, 2.0)}
    problem = problem_of(rank, mounted=True)
    found = {e.kind: (e.size, e.factor) for e in effects(problem) if e.kind in sizes}
    assert found == {kind: sizes[kind] for kind in told}
    far = wrong_offset(problem, effects(problem))
    if not told:
        assert far is None
        return
    assert far is not None and len(far) == len(effects(problem))
    assert {e.kind: (e.size, e.factor) for e in far if e.kind in sizes} == {
        **found,
        "offset": (2e-3, 3.0),
    }


def test_a_size_that_is_to_be_found_may_be_off_by_a_tenth() -> None:
    assert named(problem_of(), "size of target", size_unknown=True).size == 0.1
    assert named(problem_of(), "focal length of camera", size_unknown=True).size == 1e-3


def test_what_a_camera_s_own_errors_do_is_known_with_their_size() -> None:
    problem = problem_of()
    shared = np.random.default_rng(0).standard_normal((12, 6, 2))
    problem = replace(problem, seen=replace(problem.seen, shared=shared))
    found = named(problem, "intrinsics of camera")
    assert (found.size, found.factor, found.kind) == (1.0, 1.05, "shared")
    np.testing.assert_array_equal(block(problem, "intrinsics of camera"), shared)


# --- arms -----------------------------------------------------------------------------------------


def moved_joints(kind: str, joints: Floats, i: int) -> Floats:
    """Return which joints turn by how much for a unit of the i-th number of a kind."""
    out = np.zeros_like(joints)
    if kind == "sag":  # by the torque that the origins beyond have about it, for a unit of weight
        for sign in (1.0, -1.0):
            there = joints + sign * STEP * np.eye(6)[i]
            out[:, i] += sign * ARM.frames(there)[:, i + 1 :, 2, 3].mean(axis=1) / (2 * STEP)
        return out
    wave = {"zeros": np.ones_like, "encoders": (np.sin, np.cos)[i // 6]}[kind]
    out[:, i % 6] = wave(joints[:, i % 6])
    return out


@pytest.mark.parametrize(("kind", "name", "count"), [
    ("zeros", "joint zeros", 6), ("encoders", "encoder eccentricity", 12), ("sag", "sag", 6),
])  # fmt: skip
def test_errors_of_joints_move_what_is_seen_as_turned_joints_do(
    kind: str, name: str, count: int
) -> None:
    problem = problem_of()
    joints = problem.carriers[0].joints
    assert joints is not None
    found = block(problem, name)
    assert found.shape == (12, 6, count)
    for i in range(count):
        real = ARM.flange(joints + STEP * moved_joints(kind, joints, i))
        np.testing.assert_allclose(found[..., i], seen_from(problem, {"flange": real}), atol=1e-5)


def test_errors_of_links_move_what_is_seen_as_another_arm_does() -> None:
    problem = problem_of()
    joints = problem.carriers[0].joints
    assert joints is not None
    lengths, twists = block(problem, "link lengths"), block(problem, "link twists")
    assert (lengths.shape, twists.shape) == ((12, 6, 12), (12, 6, 6))
    for i, which in np.ndindex(6, 3):
        change = np.zeros((6, 3))
        change[i, which] = STEP
        real = ARM.perturbed(change).flange(joints)
        found = twists[..., i] if which == 2 else lengths[..., 2 * i + which]
        np.testing.assert_allclose(found, seen_from(problem, {"flange": real}), atol=1e-5)


def test_a_link_is_moved_by_the_joints_before_it_alone() -> None:
    carrier = replace(problem_of().carriers[0], link=3)
    for columns in displacements(carrier).values():
        moved = np.abs(columns).reshape(12, 6, -1).max(axis=(0, 1)) > 0
        assert 0 < moved.sum() <= columns.shape[2] / 2


def test_what_is_common_to_all_poses_turns_and_shifts_the_base_or_the_flange() -> None:
    problem = problem_of(told=False)
    flange, linear = np.asarray(problem.frames["flange"].place), problem.linearised(PLACES)
    found = [e.block(problem, linear) for e in effects(problem) if "place of the" in e.name]
    for i in range(3):
        turn, shift = (rigid(rotation_exp(STEP * np.eye(3)[i]), [0, 0, 0]), np.eye(4))
        shift[i, 3] = STEP
        there = [turn @ flange, shift @ flange, flange @ turn, flange @ shift]
        for part, real in zip(found, there, strict=True):
            np.testing.assert_allclose(
                part[..., i], seen_from(problem, {"flange": real}), atol=1e-5
            )


def test_a_smooth_error_shifts_the_flange_and_is_smooth_over_one_and_a_half_radii() -> None:
    problem = problem_of()
    flange = np.asarray(problem.frames["flange"].place)
    places = flange[:, :3, 3] - flange[:, :3, 3].mean(axis=0)
    x = places / (1.5 * np.linalg.norm(places, axis=1).max())
    bell, found = np.exp(-0.5 * (x**2).sum(axis=1)), block(problem, "smooth error")
    assert found.shape == (12, 6, 30)  # a constant, three slopes and six bends of each coordinate
    shifts = [bell, *(bell * x.T), *(bell * (x**2).T / np.sqrt(2)),
              *(bell * x[:, i] * x[:, j] for i, j in ((0, 1), (0, 2), (1, 2)))]  # fmt: skip
    expected = []
    for shift, i in ((shift, i) for shift in shifts for i in range(3)):
        real = flange.copy()
        real[:, i, 3] += STEP * shift
        expected.append(seen_from(problem, {"flange": real}))
    # In whatever order
    apart = np.abs(found[..., None] - np.stack(expected, axis=-1)[:, :, None]).max(axis=(0, 1))
    assert (apart.min(axis=0) < 1e-5).all() and (apart.min(axis=1) < 1e-5).all()


def test_backlash_is_the_noise_of_every_joint_and_of_a_pose_that_of_its_turn_and_shift() -> None:
    problem = problem_of()
    linear, zeros = problem.linearised(PLACES), block(problem, "joint zeros")
    expected = sum(zeros[..., i, None] * zeros[:, None, :, i] for i in range(6))
    (backlash,) = arm_scatters(problem)
    np.testing.assert_allclose(backlash.covariances(problem, linear), expected)
    bare = problem_of(told=False)
    for scatter, rows in zip(arm_scatters(bare), (slice(3), slice(3, 6)), strict=True):
        moves = linear.blocks["flange"][:, :, rows]
        expected = np.einsum("nik,njk->nij", moves, moves)
        np.testing.assert_allclose(scatter.covariances(bare, linear), expected, atol=1e-12)


# --- targets and cameras --------------------------------------------------------------------------


def test_a_tilted_face_turns_and_a_circle_off_its_place_shifts_what_is_seen() -> None:
    problem = problem_of(5, mounted=True)
    for name, count in (("tilt of the face", 2), ("offset of the circle", 3)):
        found = block(problem, name)
        assert found.shape == (12, 6, count)
        for i in range(count):
            one = STEP * np.eye(3)[i]
            off = rigid(rotation_exp(one), [0, 0, 0]) if count == 2 else rigid(np.eye(3), one)
            seen = seen_from(problem, {"target": PLACES["target"] @ off})
            np.testing.assert_allclose(found[..., i], seen, atol=1e-5)


@pytest.mark.parametrize("error", [1e-4, 4.9e-3, 5.1e-3])
def test_an_offset_shows_as_far_as_the_flange_is_turned(error: float) -> None:
    problem = problem_of(5, mounted=True)
    turns = problem.seen.rotations - problem.seen.rotations.mean(axis=0)
    seen = replace(problem.seen, centres=problem.seen.centres + [error, -error, error])
    told = np.linalg.inv(sum(turn.T @ turn for turn in turns))
    expected = error * np.sqrt(np.linalg.eigvalsh(told)[-1]) if error < 5e-3 else 0.0
    assert offset_shown_to(replace(problem, seen=seen), PLACES) == pytest.approx(expected)


def two_cameras() -> Problem:
    """Return a problem in which two cameras in one place see two targets in another in turn."""
    problem = problem_of()
    frames = {**problem.frames, "other": Frame("base", PLACES["camera"]),
              "second": Frame("flange", PLACES["target"])}  # fmt: skip
    seen = replace(problem.seen, pairs=np.arange(12) % 2)
    ends = [("camera", "target"), ("other", "second")]
    return replace(problem, frames=frames, ends=ends, seen=seen)


@pytest.mark.parametrize(("name", "pair"), [
    ("size of target", 0), ("size of second", 1), ("focal length of camera", 0),
    ("focal length of other", 1),
])  # fmt: skip
def test_a_marker_that_is_larger_and_a_longer_focal_length_bring_it_nearer(
    name: str, pair: int
) -> None:
    problem = two_cameras()
    whose, predicted = problem.seen.pairs == pair, problem.seen.centres
    # Seen with noise across the line of sight, and a tenth farther away than it is
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (12, 3))
    noise -= predicted * ((noise * predicted).sum(axis=1) / (predicted**2).sum(axis=1))[:, None]
    far = replace(problem, seen=replace(problem.seen, centres=1.1 * predicted + noise))
    for each, size in ((problem, 1.0), (far, 1.1)):
        expected = np.zeros((12, 6, 1))
        rows = slice(5, 6) if "focal" in name else slice(3, 6)
        expected[whose, rows, 0] = -size * predicted[whose][:, rows.start - 3 :]
        np.testing.assert_allclose(block(each, name), expected, atol=1e-12)


@pytest.mark.parametrize(("n", "knots"), [(9, 0), (10, 2), (24, 4), (30, 6), (70, 6)])
def test_a_camera_drifts_in_straight_pieces_of_five_sightings_about_its_place(
    n: int, knots: int
) -> None:
    problem = problem_of(n=n)
    later = np.random.default_rng(2).permutation(n)
    problem = replace(problem, seen=replace(problem.seen, times=later))
    drifts = [e for e in effects(problem) if e.kind == "drift"]
    assert len(drifts) == (2 if knots else 0)
    ramp = np.linspace(0.0, knots - 1.0, n)
    for drift, rows in zip(drifts, (slice(3, 6), slice(3)), strict=knots > 0):
        found = drift.block(problem, problem.linearised(PLACES))
        assert found.shape == (n, 6, 3 * (knots - 1))
        expected = np.zeros((n, 6, 3 * knots))
        for k in range(knots):
            hat = np.interp(ramp, np.arange(knots), np.eye(knots)[k])
            expected[:, rows, 3 * k : 3 * k + 3] = (hat - hat.mean())[later, None, None] * np.eye(3)
        # The same drifts are as likely by one number fewer, for their mean is none
        one, other = (each.reshape(6 * n, -1) for each in (found, expected))
        np.testing.assert_allclose(one @ one.T, other @ other.T, atol=1e-12)


def test_a_clock_that_is_late_shifts_what_one_camera_sees_along_the_arm_s_motion() -> None:
    problem, rng = two_cameras(), np.random.default_rng(5)
    rates = rng.standard_normal((12, 6))
    assert not [e for e in effects(problem) if e.kind == "clock"]
    problem = replace(problem, carriers=[replace(problem.carriers[0], rates=rates)])
    real = np.asarray(problem.frames["flange"].place).copy()
    real[:, :3, :3] = rotation_exp(STEP * rates[:, :3]) @ real[:, :3, :3]
    real[:, :3, 3] += STEP * rates[:, 3:]
    seen = seen_from(problem, {"flange": real})
    for pair, camera in enumerate(("camera", "other")):
        found = named(problem, f"clock of {camera}")
        assert (found.size, found.factor, found.lasting) == (20e-3, 4.0, False)
        expected = np.where((problem.seen.pairs == pair)[:, None], seen, 0.0)[..., None]
        np.testing.assert_allclose(block(problem, found.name), expected, atol=1e-5)


# --- scanners -------------------------------------------------------------------------------------

SCANNER = load_model("scanners", "phoxi-m")


def in_view(count: int) -> Floats:
    """Return points (N, 3) of a scanner's volume on a grid of its rays and depths."""
    steps = np.linspace(-1.0, 1.0, count)
    depth = (SCANNER.near + SCANNER.far) / 2 + (SCANNER.far - SCANNER.near) / 2 * steps
    right, down = (np.tan(angle / 2) * steps for angle in SCANNER.field_of_view)
    return np.array([[x * z, y * z, z] for x in right for y in down for z in depth])


def test_a_distortion_is_as_large_as_the_scanner_s_error_and_moves_nothing_as_a_whole() -> None:
    points = in_view(7)
    bent = DistortionField(SCANNER).at(points)
    assert np.sqrt((bent**2).sum(axis=(1, 2)).mean()) == pytest.approx(0.1e-3)
    assert bent.shape[2] == 60  # third powers of three coordinates, along the ray and across it
    for k in range(bent.shape[2]):
        turn, shift = kabsch(points, points + bent[..., k])
        assert np.linalg.norm(rotation_log(turn)) < 1e-7
        assert np.linalg.norm(turn @ points.mean(axis=0) + shift - points.mean(axis=0)) < 1e-8


def test_across_its_rays_a_scanner_errs_by_the_ratio_of_its_baseline_to_its_distance() -> None:
    def across(baseline: float) -> float:
        """Return the errors across the rays, in those along them."""
        scanner = SCANNER.model_copy(update={"baseline": baseline})
        bent = DistortionField(scanner).at(in_view(5))
        ways = [float(np.linalg.norm(bent[..., way::3])) for way in range(3)]
        return (ways[1] + ways[2]) / ways[0]

    # Over the root of two: of either ray's; and not by more than along them
    assert across(0.35) / across(10.0) == pytest.approx(350 / 788 / np.sqrt(2))
    assert across(1.2) == pytest.approx(across(10.0))


def test_a_distortion_turns_a_target_as_the_rim_of_a_flange_is_bent() -> None:
    field, rng = DistortionField(SCANNER), np.random.default_rng(0)
    problem = problem_of(5)
    turns = rotation_exp(rng.uniform(-1.0, 1.0, (12, 3)))
    seen = replace(problem.seen, rotations=turns, centres=in_view(12)[::150][:12])
    moves = field.moves(seen)
    np.testing.assert_allclose(moves[:, 3:], field.at(seen.centres))
    rim = 30e-3 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    for n in range(12):
        points = rim @ turns[n].T + seen.centres[n]
        bent = field.at(points)
        for k in range(bent.shape[2]):
            turn, _ = kabsch(points, points + 1e-3 * bent[..., k])
            np.testing.assert_allclose(1e3 * rotation_log(turn), moves[n, :3, k], atol=1e-6)


def test_a_scanner_s_distortion_is_assumed_with_what_of_it_a_session_shows() -> None:
    problem = problem_of(5)
    found = [e for e in effects_of(problem, SCANNER, ModelOptions()) if e.kind == "scanner"]
    assert [(e.name, e.factor) for e in found] == [
        ("scanner distortion", 1.1),
        ("rounded edges", 1.1),
    ]
    assert found[0].size == 1.0
    image = replace(problem, seen=replace(problem.seen, by_depth=np.zeros(12, dtype=bool)))
    assert not [e for e in effects_of(image, SCANNER, ModelOptions()) if e.kind == "scanner"]


def tilted(angle: float) -> Problem:
    """Return circles of unknown place half a metre in front, all tilted by so much."""
    problem, n = problem_of(5), 12
    about = 2 * np.pi * np.arange(n) / n
    axes = np.stack([np.cos(about), np.sin(about), 0 * about], axis=1)
    facing = np.diag([1.0, -1.0, -1.0])
    turns = rotation_exp(angle * axes) @ facing
    normals = turns[:, :, 2]
    projectors = np.tile(np.eye(6), (n, 1, 1))
    projectors[:, :3, :3] -= normals[:, :, None] * normals[:, None]
    seen = replace(problem.seen, rotations=turns, centres=np.tile([0.0, 0.0, 0.5], (n, 1)),
                   projectors=projectors)  # fmt: skip
    return replace(problem, seen=seen)


@pytest.mark.parametrize(("angle", "known"), [(0.5, True), (1.01e-3, True), (0.99e-3, False)])
def test_rounded_edges_shift_a_tilted_circle_from_the_camera_s_side(
    angle: float, known: bool
) -> None:
    problem = tilted(angle)
    found = [e for e in effects(problem) if e.name == "rounded edges"]
    assert len(found) == known
    if not known:
        return
    # Deviations of 0.1 mm across the face, for a shift as long as the tilt's sine
    assert found[0].size == pytest.approx(np.sqrt(2.0) * 1e-4 / np.sin(angle))
    shift = found[0].block(problem, problem.linearised(PLACES))[..., 0]
    assert not shift[:, :3].any()
    np.testing.assert_allclose(np.linalg.norm(shift[:, 3:], axis=1), np.sin(angle))
    # In the face, and towards the camera
    normals = problem.seen.rotations[:, :, 2]
    np.testing.assert_allclose((shift[:, 3:] * normals).sum(axis=1), 0.0, atol=1e-12)
    assert (shift[:, 5] <= -(np.sin(angle) ** 2) * (1 - 1e-9)).all()
