"""Files that appear whole: folders of results, locks, journals, jobs, products by digest."""
