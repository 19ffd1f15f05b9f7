"""Simulated devices that exchange the real bytes, and the bench and scenes that they look at."""
