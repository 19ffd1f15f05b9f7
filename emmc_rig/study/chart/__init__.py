"""Speed against accuracy: every method measured on the same frames, and its charts."""
