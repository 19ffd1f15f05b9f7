"""The set-up page: what the camera sees, live, with the stage and the exposure at hand."""
