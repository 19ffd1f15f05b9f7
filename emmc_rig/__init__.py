"""The application: bench sessions, reports and the command line, over the camera model."""

__version__ = "0.1.0"
