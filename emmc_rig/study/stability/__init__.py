"""Where methods fail: sweeps of faults by strength, each method's curve and breaking points."""
