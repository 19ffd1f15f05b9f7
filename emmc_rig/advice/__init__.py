"""Which method to take, by a trial on the frames at hand."""
