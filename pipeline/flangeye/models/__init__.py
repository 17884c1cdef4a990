"""What a recipe names: robots, scanners, flange standards, boards, workpieces, configurations."""
