"""The compliant finger, simulated: a tip in a groove, and what the camera above its tag sees."""
