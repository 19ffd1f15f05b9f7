"""Pages and pictures of every report: templates, drawings, figures of a frame."""
