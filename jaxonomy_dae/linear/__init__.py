"""Linear operators and solvers: written out, dense, sparse."""
