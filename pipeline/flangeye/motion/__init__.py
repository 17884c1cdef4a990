"""Move an arm safely: reachable poses, collision-free routes, and supervision.

``reach`` and ``clearance`` know what an arm can show a scanner; ``limits`` what the recipe allows;
``route`` finds a checked way between two poses; ``watchdog`` judges every sample of an arm under
way; ``supervision`` runs it in a process of its own, so that no computation here can delay a stop;
``arm`` is the program's side of that process. ``planning`` and ``seam_following`` hold the
contracts of plugins that choose poses and follow seams.
"""
