#!/bin/sh
# The welds of figure 13 and the table in plugins/flangeye_plugins/weld again:
#   ./weld.sh [FOLDER_FOR_BATCHES]
#
# By touch each workpiece is welded with half of a hundred seeds; fewer with SEEDS=5. It takes about
# half an hour of one core; a batch that was broken off goes on where it stopped.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
out=${1:-batches/paper}
mkdir -p "$out"
cd "$out"

batch() { flangeye batch "$@" --vary seed --no-report ${WORKERS:+--workers "$WORKERS"}; }

for seam in straight curved; do
  recipe="$here/fig13_$seam.yaml"
  batch "$recipe" --repeat 3 --set-grid steps.5.mode=vision,as_printed --out "fig13-others_$seam"
  batch "$recipe" --repeat 5 --set steps.5.sensor.simulated_finger.world=wall_missing \
    --out "fig13-gap_$seam"
  batch "$recipe" --repeat 5 --set steps.5.start_angle='90 deg' --out "fig13-across_$seam"
done
for seam in straight curved; do
  batch "$here/fig13_$seam.yaml" --repeat "${SEEDS:-50}" --out "fig13_$seam"
done

welding=$here/../../plugins/flangeye_plugins/weld
if [ -d "$welding" ]; then
  python -m flangeye_paper fig13 . --out "$welding"
  python -m flangeye_paper page "$welding/README.md"
fi
