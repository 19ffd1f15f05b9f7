"""Calibration: from whiteboard and dark frames to the imaging matrix and its uncertainty."""
