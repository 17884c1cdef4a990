"""Kind ``arc``: welding power sources, for weld.tactile."""
