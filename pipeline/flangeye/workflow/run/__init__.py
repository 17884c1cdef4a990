"""Running a checked recipe: runner, session, restart from a log, replay, run folder."""
