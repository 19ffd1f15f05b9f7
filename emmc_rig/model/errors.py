"""Errors of the camera model: each message says what is wrong and what to do, in one line."""


class ModelError(Exception):
    """Root of the model's errors; shown to the user as one line."""


class SceneError(ModelError):
    """A light field that cannot be read or is not one."""


class CameraError(ModelError):
    """A camera description that cannot be built."""


class SensingError(ModelError):
    """An imaging matrix, or data given to it, that does not fit."""
