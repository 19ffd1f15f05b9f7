"""The store: files that appear whole, results, locks, journals, and products by digest."""
