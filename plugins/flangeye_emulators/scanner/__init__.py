"""``scanner.emulator``: a scanner that sees a simulated cell."""
