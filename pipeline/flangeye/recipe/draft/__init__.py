"""``flangeye init``: from what a folder holds, or what runs, to a recipe that passes."""

from flangeye.recipe.draft.live import draft_live
from flangeye.recipe.draft.questions import Questions
from flangeye.recipe.draft.recipe import Draft, draft_recipe
from flangeye.recipe.draft.survey import look

__all__ = ["Draft", "Questions", "draft_live", "draft_recipe", "look"]
