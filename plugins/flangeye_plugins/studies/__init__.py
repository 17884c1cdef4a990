"""The paper's studies, done again: what only they need. No solver for a real cell is here.

Stages and parts whose names end in ``as_in_paper`` emulate what the authors did, mistakes
included, to find out where their numbers come from. ``python -m flangeye_plugins.studies`` turns
the tables of ``flangeye batch`` into the figures of ``recipes/paper``.
"""
