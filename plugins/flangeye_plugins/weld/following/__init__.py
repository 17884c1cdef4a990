"""Following a seam by touch: belief, measurements, the felt seam, the torch and its bound."""
