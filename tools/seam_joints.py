"""How well seam.joint finds six joints in ray-cast scans with faults: python -m tools.seam_joints --scans 50

Each scan has noise, 10 % and patches of pixels missing, mixed pixels, second bounces, patches that are
off, and blocks that lie about, one on the seam; the rough line is up to 4 mm off at either end.
Wrong is what is off by more than 0.5 mm and by more than four of its own standard deviations.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.maths.seam_geometry import tube_radii
from flangeye.types import CAMERA, PointCloud, WorkpieceScan
from flangeye_plugins.seam.joint import JointParams, seam_joint
from tests.plugins.seam.raycast import JOINTS, scan_of
from tests.plugins.seam.scenes import BASE_T_CAMERA, hand_eye

MM = 1e-3
ROUGH = 4 * MM


def planned(scan, joint, seed=0, **given):
    """Return the seam found in a ray-cast scan, and the true one (2, 3), in base."""
    truth = BASE_T_CAMERA.apply(scan.seam)
    rough = truth + np.random.default_rng([seed, 5]).uniform(-ROUGH, ROUGH, (2, 3))
    line = [[f"{1e3 * v} mm" for v in point] for point in rough]
    params = JointParams.model_validate({"joint": joint, "line": line, **given})
    cloud = PointCloud(CAMERA, scan.points.astype(np.float32))
    return seam_joint(hand_eye(), WorkpieceScan(cloud, f"{joint} {seed}"), params), truth


def outcome(seed, joint):
    """Return what was found of one scan: errors in mm, or why it was refused."""
    try:
        seam, truth = planned(scan_of(joint, seed), joint, seed)
    except FlangeyeError as error:
        return {"joint": joint, "seed": seed, "refused": str(error)}
    length = np.linalg.norm(truth[1] - truth[0])
    along = (truth[1] - truth[0]) / length
    away = seam.points_in_base - truth[0]
    s = away @ along
    across = np.linalg.norm(away - s[:, None] * along, axis=1)
    ends = np.abs([s[0], s[-1] - length])
    sigmas = np.array([seam.figures.get(name, np.inf) for name in ("start", "end")])
    wrong = (across > 0.5 * MM) & (across > 4 * tube_radii(seam) / 2.45)
    wrong_ends = (ends > 0.5 * MM) & (ends > 4 * sigmas)
    return {
        "joint": joint,
        "seed": seed,
        "across": float(np.median(across) / MM),
        "largest": float(across.max() / MM),
        "inside": float((across <= tube_radii(seam)).mean()),
        "ends": (ends / MM).tolist(),
        "wrong": bool(wrong.any() or wrong_ends.any()),
    }


def table(found):
    rows = [
        "| joint | found | across, median mm | 95 % mm | largest mm | in the tube | ends, median mm | 95 % mm | wrong |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for joint in JOINTS:
        mine = [f for f in found if f["joint"] == joint]
        good = [f for f in mine if "refused" not in f]
        if not good:
            continue
        across, ends = [f["across"] for f in good], np.ravel([f["ends"] for f in good])
        rows.append(
            f"| {joint} | {len(good)} of {len(mine)} | {np.median(across):.3f} | {np.quantile(across, 0.95):.3f} "
            f"| {max(f['largest'] for f in good):.2f} | {np.mean([f['inside'] for f in good]):.0%} "
            f"| {np.median(ends):.2f} | {np.quantile(ends, 0.95):.2f} | {sum(f['wrong'] for f in good)} |"
        )
    return "\n".join(rows)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=50, help="of each joint")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--joint", choices=JOINTS, action="append", help="only these")
    parser.add_argument("--json", action="store_true", help="a line for each scan")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args(argv)
    seeds, found = range(given.first, given.first + given.scans), []
    with ProcessPoolExecutor(given.jobs) as pool:
        for joint in given.joint or JOINTS:
            for result in pool.map(partial(outcome, joint=joint), seeds):
                found.append(result)
                if given.json:
                    print(json.dumps(result), flush=True)
    print(table(found))


if __name__ == "__main__":
    main()
