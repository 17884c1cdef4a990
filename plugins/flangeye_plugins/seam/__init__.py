"""``seam.*`` stages: plan the seam to weld from a CAD, from a joint in the scan, or from a file."""
