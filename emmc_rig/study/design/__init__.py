"""Which mask to order: candidates that a bench can mount, by their expected error."""
