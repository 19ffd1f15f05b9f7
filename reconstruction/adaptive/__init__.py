"""Adaptive reconstruction: the measurements choose, per place, how much model they support.

"2x +0.09, 0.5x -0.11 dB" after a constant is the PSNR lost with twice and half of it, the mean of
middles of dragons, dice, fish and begonia (64x64, one CFA shot, `benchmarks/constants.py`).
docs/results/constants.csv has them all, the settings too, with their standard errors.
"""
