"""Cameras of GenTL producers, through harvesters: a plug-in of emmc-rig."""
