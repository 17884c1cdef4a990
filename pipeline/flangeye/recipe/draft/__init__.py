"""``flangeye init``: from what a folder holds to a recipe that passes ``flangeye check``."""

from flangeye.recipe.draft.questions import Questions
from flangeye.recipe.draft.recipe import Draft, draft_recipe
from flangeye.recipe.draft.survey import look

__all__ = ["Draft", "Questions", "draft_recipe", "look"]
