"""``reader.*`` parts: layouts of archives and tables of poses, one module per layout."""
