"""Numbers in the precision of a kernel: vectors, polynomial approximations, random numbers by counter, grids."""
