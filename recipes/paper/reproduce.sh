#!/bin/sh
# Everything on this page again: ./reproduce.sh PUBLISHED_FOLDER [FOLDER_FOR_BATCHES [PART...]]
#
# The published folder is github.com/ancorasir/flange_handeye_calibration. It takes about an hour of
# one core, a third of it for figure 11, and half an hour more for figure 13; a batch that was broken
# off goes on where it stopped.
# Parts: simulated table1 figure11 table2 figure13 heldout; all of them without one.
# WORKERS=1 leaves the other cores to others.
set -eu
published=$(realpath "$1")
out=${2:-batches/paper}
[ $# -gt 2 ] && shift 2 || set -- simulated table1 figure11 table2 figure13 heldout
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$out"
cd "$out"

batch() { flangeye batch "$@" --no-report ${WORKERS:+--workers "$WORKERS"}; }
study() { python -m flangeye_paper "$@" --out "$here"; }

# Section 3.1, simulated point by point
simulated() {
  levels=$(seq -s, -f '%.1f mm' 0.2 0.2 10)
  tens=$(seq -s, -f '%g mm' 1 10)
  # Algorithm 1 with a held-out cost is our addition, and slow: fewer levels show its slope.
  fives=$(seq -s, -f '%g mm' 2 2 10)
  counts="$(seq -s, 5 20),$(seq -s, 22 2 40),$(seq -s, 45 5 75)"
  for method in all-data algorithm-1-oracle robust; do
    recipe="$here/fig9_$method.yaml"
    batch "$recipe" --set-grid steps.0.noise="$levels" --out "fig9_$method"
    batch "$recipe" --set-grid steps.0.noise="$tens" --set steps.0.outliers=0.15 \
      --out "fig9-outliers_$method"
  done
  for method in all-data algorithm-1-oracle; do
    batch "$here/fig9_$method.yaml" --set-grid steps.0.poses="$counts" --out "fig10_$method"
  done
  batch "$here/fig9_robust.yaml" --set-grid steps.0.poses=5,6,8,10,12,15,20,25,30,40,50,60,75 \
    --out fig10_robust
  method=algorithm-1-held-out
  recipe="$here/fig9_$method.yaml"
  batch "$recipe" --set-grid steps.0.noise="$fives" --out "fig9_$method"
  batch "$recipe" --set-grid steps.0.noise="$fives" --set steps.0.outliers=0.15 \
    --out "fig9-outliers_$method"
  # Ten poses are kept from the pool to measure on, so it begins at 14.
  batch "$recipe" --set-grid steps.0.poses=15,20,40,75 --out "fig10_$method"
  batch "$here/fig9_algorithm-1-oracle.yaml" --set-grid steps.1.pool=4,5,6 \
    --set steps.2.count=200 --out fig9-pools
  study fig9 .
  study fig10 .
}

# Section 3.2: Table 1, published recordings
table1() {
  both=open3d_0_7_normals,sound
  batch "$here/table1_ur5.yaml" "$published" --out table1_ur5
  batch "$here/table1_franka.yaml" "$published" --out table1_franka
  batch "$here/table1_aubo.yaml" "$published" --set-grid steps.2.normals=$both --out table1_aubo
  batch "$here/table1_aubo.yaml" "$published" --set-grid steps.2.normals=$both \
    --set-grid steps.2.iterations=1,2,3,4,5,6,7,8,10,12,15,20,30,50,100,200,500 \
    --set steps.2.change=0 --out table1_aubo-iterations
  # A millimetre is too near for ICP to begin: those sessions are refused, as the table says.
  batch "$here/table1_kinect.yaml" "$published" --set-grid steps.2.normals=$both \
    --set-grid steps.2.distance=1,2,3,5 --out table1_kinect || true
  study table1 .
}

# Section 3.2: Figure 11, published recordings
figure11() {
  batch "$here/fig11_aubo.yaml" "$published" --repeat "${SHUFFLES:-50}" --vary seed --out fig11_aubo
  study fig11 . --archive "$published"
}

# Table 2, simulated
table2() {
  for target in flange sphere; do
    batch "$here/table2_$target.yaml" --repeat 12 --vary seed \
      --set-grid steps.0.poses.grid.counts='[2, 2, 1],[4, 2, 2]' --out "table2_$target"
    batch "$here/table2_$target.yaml" --repeat 12 --vary seed \
      --set steps.0.poses.grid.counts='[4, 2, 2]' \
      --set steps.0.poses.grid.size='[60 mm, 60 mm, 40 mm]' --out "table2-narrow_$target"
  done
  study table2 .
}

# Figure 13, simulated; the tables are in plugins/flangeye_plugins/weld
figure13() {
  "$here/weld.sh" .
}

# Beyond the paper: errors on poses that took no part
heldout() {
  [ -d aubo-fitted ] ||
    flangeye run "$here/heldout_fit.yaml" --archive "$published" --out aubo-fitted
  aubo=$published/data/aubo ur5=$published/data/ur5 franka=$published/data/franka
  for method in all-data algorithm-1 robust; do
    batch "$here/heldout_$method.yaml" aubo-fitted/run.mcap "$aubo" "$ur5" "$franka" \
      --repeat 5 --vary seed --out "heldout_$method"
  done
  joints="$here/heldout_robust-joints.yaml"
  batch "$joints" aubo-fitted/run.mcap "$aubo" --repeat 3 --vary seed --out heldout_robust-joints
  batch "$joints" "$ur5" --set robot.model=ur5 --repeat 3 --vary seed \
    --out heldout_robust-joints_ur5
  batch "$joints" "$franka" --set robot.model=franka-panda --repeat 3 --vary seed \
    --out heldout_robust-joints_franka
  study heldout . --archive "$published"
}

for part in "$@"; do "$part"; done
python -m flangeye_paper page "$here/README.md"
