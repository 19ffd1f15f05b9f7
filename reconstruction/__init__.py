"""Reconstruction: from frames and the imaging matrix to the light field."""
