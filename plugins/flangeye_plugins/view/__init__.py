"""``view.*``: first guesses of the scanner pose, for planning. Add one: here, in ``guess``."""
