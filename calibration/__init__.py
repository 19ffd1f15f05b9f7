"""Calibration: from whiteboard and dark frames to the imaging matrix and its uncertainty."""

if __name__ == "calibration":  # imported from the folder beside emmc_rig, as before version 0.5
    raise ModuleNotFoundError(f"import emmc_rig.{__name__}, its name since 0.5", name=__name__)
