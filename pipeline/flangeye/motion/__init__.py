"""Move an arm safely: reachable poses, collision-free routes, and supervision.

``reach`` and ``clearance`` determine the poses at which an arm can be scanned, ``limits`` what the
recipe allows, and ``route`` finds a checked path between two poses. ``supervision`` judges every
sample of a moving arm; ``watchdog`` does so in a separate process, so that no computation of the
program can delay a stop, and ``arm`` is the program's side of that process. ``planning`` and
``seam_following`` contain the contracts of plugins that choose poses and follow seams.
"""
