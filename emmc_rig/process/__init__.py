"""Whiteboards to Psi; frames and Psi to a light field with its verdict."""
