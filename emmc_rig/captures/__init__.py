"""Captures: plans, their order, and the sequencer that fills a session."""
