"""Where methods fail: faults of every strength, each method's curve, its breaking points."""
