"""A cell with truth: an arm, its flange, their surroundings, and the scanners that look at them."""
