"""Frames and Psi to a result with its verdict and files; `reconstruction` holds the solvers."""
