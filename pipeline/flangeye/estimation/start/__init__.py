"""Where an estimate begins: sightings of the observations, and places by closed forms."""
