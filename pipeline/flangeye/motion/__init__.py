"""Moving an arm safely: where it may go, how it gets there, and who watches it on the way.

``reach`` and ``clearance`` know what an arm can show a scanner; ``limits`` what the recipe allows;
``route`` finds a checked way between two poses; ``watchdog`` judges every sample of an arm under
way; ``supervision`` runs it in a process of its own, so that no computation here can delay a stop;
``arm`` is this side of it. ``planning`` and ``seam_following`` hold the contracts of plugins that
choose poses and follow seams.
"""
