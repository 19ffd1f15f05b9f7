"""Errors of the application: each message says what is wrong and what to do, in one line."""


class AppError(Exception):
    """Root of the application's errors; shown to the user as one line."""
