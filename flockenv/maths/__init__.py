"""Mathematics in the precision of a kernel: vectors, polynomial approximations, counter-based random numbers, grids."""
