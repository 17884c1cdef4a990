"""Models that recipes name: robots, scanners, flange standards, boards, workpieces, mountings."""
