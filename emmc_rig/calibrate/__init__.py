"""`emmc-rig calibrate`: whiteboards of a session, or of a simulated bench, to Psi."""
