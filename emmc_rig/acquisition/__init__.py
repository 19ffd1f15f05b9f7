"""Capture: a plan, the order it is run in, and the sequencer that fills a session."""
