"""Whether a calibration still holds: drift tests on later sightings. Arrays only."""
