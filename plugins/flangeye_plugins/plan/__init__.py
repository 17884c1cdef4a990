"""Where to send the arm: plans of poses, and what is guessed of the scanner before the first."""
