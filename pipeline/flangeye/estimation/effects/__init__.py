"""What can be wrong with a cell: one effect a file, each a design block and a typical size."""
