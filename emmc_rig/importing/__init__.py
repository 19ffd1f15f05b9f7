"""Files of another program as a session."""
