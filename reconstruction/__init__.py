"""Reconstruction: from frames and the imaging matrix to the light field."""

if __name__ == "reconstruction":  # imported from the folder beside emmc_rig, as before version 0.5
    raise ModuleNotFoundError(f"import emmc_rig.{__name__}, its name since 0.5", name=__name__)
