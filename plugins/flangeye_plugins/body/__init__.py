"""Find a rigid body of known shape in a scan."""
