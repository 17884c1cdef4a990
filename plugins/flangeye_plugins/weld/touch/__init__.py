"""Detection of the tag in the finger camera's image, and the tip's displacement from it."""
