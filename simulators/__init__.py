"""Simulated devices that speak the real bytes, and the bench and scenes that they look at."""
