"""Speed against accuracy: every method measured on the same frames, its charts, and advice."""
