"""Measurements of the methods and of the machine: sweeps, their tables, charts and checks."""
