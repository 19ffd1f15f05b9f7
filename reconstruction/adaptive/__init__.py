"""Adaptive reconstruction: the measurements choose, per place, how much model they support."""
