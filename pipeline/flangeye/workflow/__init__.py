"""From a recipe through its run to log, result and report, and judging or repeating what ran."""
