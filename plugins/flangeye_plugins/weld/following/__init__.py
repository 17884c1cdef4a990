"""Following a seam by touch: prior, measurements, seam estimate, torch control and error bound."""
