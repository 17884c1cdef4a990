"""``robot.simulated`` and ``robot.emulator``: arms without hardware."""
