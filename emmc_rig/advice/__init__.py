"""Which method and settings to take, from a chart of earlier measurements."""
