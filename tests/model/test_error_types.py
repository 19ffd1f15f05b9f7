"""Public errors derive from built-in types, so that callers may catch OSError or ValueError."""

import pickle

import pytest

import emmc_rig
from emmc_rig.drivers import errors as driver_errors
from emmc_rig.drivers.errors import DriverError, GarbledReplyError, UsbGoneError
from emmc_rig.errors import AppError, StoppedError, WrongUsageError
from emmc_rig.model.arguments import ArgumentError
from emmc_rig.model.errors import CameraError, SceneError, SensingError
from emmc_rig.model.settings import validated
from emmc_rig.session.lock import HeldError
from emmc_rig.store.jobs import kept_words
from emmc_rig.store.pool import WorkersError

CALIBRATION, RECONSTRUCTION = emmc_rig.ERRORS[3], emmc_rig.ERRORS[4]
OTHERS = {
    ValueError: {SceneError, CameraError, SensingError, CALIBRATION, RECONSTRUCTION},
    TypeError: {ArgumentError},
    BlockingIOError: {HeldError},
    ConnectionError: {WorkersError},
}
DRIVERS = {
    FileNotFoundError: "PortNotFound UsbNotFound",
    PermissionError: "PortPermission UsbPermission",
    ConnectionError: "PortGone UsbGone",
    TimeoutError: "TransportTimeout MoveTimeout UsbTimeout CameraBusy NoFrame",
    ValueError: "UnknownAxis LimitExceeded SpeedLimit SpeedFixed CameraSetting RawFrame",
}


def _specific(kind):
    """Return the most derived of the built-in types of a class."""
    built_in = [base for base in kind.__mro__ if base.__module__ == "builtins"]
    return {a for a in built_in if not any(issubclass(b, a) and b is not a for b in built_in)}


def test_errors_of_input_stores_and_workers_are_of_the_built_in_type_that_fits():
    for built_in, kinds in {**OTHERS, ValueError: OTHERS[ValueError] | {WrongUsageError}}.items():
        for kind in kinds:
            assert _specific(kind) == {built_in}, kind
    # The root of mixed faults is of no one type, and who stops a program makes no error.
    assert _specific(AppError) == _specific(StoppedError) == {Exception}


def test_every_drivers_error_is_an_os_error_and_some_are_more():
    more = {f"{name}Error": kind for kind, names in DRIVERS.items() for name in names.split()}
    kinds = [kind for kind in vars(driver_errors).values() if isinstance(kind, type)]
    kinds = [kind for kind in kinds if issubclass(kind, DriverError)]
    assert len(kinds) > 40
    for kind in kinds:
        own = more.pop(kind.__name__, OSError)
        assert _specific(kind) == ({ValueError, OSError} if own is ValueError else {own}), kind
    assert not more


def test_a_drivers_error_keeps_its_words_and_its_data():
    fault = UsbGoneError("the camera")
    assert str(fault).startswith("the camera went away: plug it in")
    assert (fault.reason, fault.errno) == ("the camera", None)
    garbled = GarbledReplyError(b"\xff", "no message")
    assert "garbled reply" in str(garbled)
    restored = pickle.loads(pickle.dumps(DriverError("broken", "mend it")))
    assert isinstance(restored, DriverError)


def test_an_error_of_a_file_s_camera_is_no_error_of_the_validator():
    from emmc_rig.model.camera import Sensor

    with pytest.raises(CameraError, match="unknown CFA 'rgbx'") as caught:
        validated(Sensor, {"cfa": "rgbx"}, "c.yaml", CameraError)
    assert type(caught.value) is CameraError


@pytest.mark.parametrize("fault", [UsbGoneError("the camera"), WorkersError("all lost")])
def test_a_job_words_the_disk_s_faults_and_not_those_of_devices_and_workers(tmp_path, fault):
    with pytest.raises(type(fault)) as caught, kept_words(tmp_path, lambda: ""):
        raise fault
    assert caught.value is fault
    with pytest.raises(AppError, match="cannot be written"), kept_words(tmp_path, lambda: ""):
        raise OSError(28, "No space left on device")
