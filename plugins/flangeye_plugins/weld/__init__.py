"""``weld.*`` stages: a finger follows the seam by touch, and the torch welds behind it."""
