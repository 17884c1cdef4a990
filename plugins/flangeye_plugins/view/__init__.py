"""``view.*``: first guesses of the scanner pose, for planning."""
