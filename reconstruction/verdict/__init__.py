"""Whether a light field can be trusted: what the frames, Psi and held-out readings say about it."""
