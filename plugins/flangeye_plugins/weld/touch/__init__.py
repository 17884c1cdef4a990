"""What the finger's camera says: the tag in an image, and how the tip is displaced."""
