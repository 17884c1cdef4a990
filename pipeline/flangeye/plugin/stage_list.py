"""The list of ``flangeye stages``, remembered until a file of a plugin changes.

Making it imports every plugin, which takes longer than people wait for a list.
"""

from __future__ import annotations

from flangeye.files.memory import keep, recall
from flangeye.plugin.installed import installed_digest

SORT = "stages"


def recall_list() -> str | None:
    """Return the list as it was made before, None where something changed since."""
    return recall(SORT, installed_digest())


def list_stages() -> str:
    """Return every stage and part of the installed plugins, grouped by kind, a line each.

    Raises:
        DuplicatePluginError: Two plugins offer the same stage or part.
    """
    installed = installed_digest()
    known = recall(SORT, installed)
    if known is not None:
        return known
    from flangeye.plugin.describe import describe_all
    from flangeye.plugin.registry import load_registry

    registry = load_registry()
    text = describe_all(registry)
    if not registry.broken:  # what is missing may be installed any time, elsewhere
        keep(SORT, installed, text)
    return text
