"""What a calibration answers: places, expected error at the work, corrections of an arm."""
