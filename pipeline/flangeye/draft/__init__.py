"""``flangeye init``: from what a folder holds to a recipe that passes ``flangeye check``."""

from flangeye.draft.questions import Questions
from flangeye.draft.recipe import Draft, draft_recipe
from flangeye.draft.sights import look

__all__ = ["Draft", "Questions", "draft_recipe", "look"]
