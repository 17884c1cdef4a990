"""A session as it was recorded, and as its tables could be read otherwise."""
