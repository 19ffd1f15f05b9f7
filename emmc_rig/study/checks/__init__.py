"""Measurements of the calibration on the simulated bench, against its targets."""
