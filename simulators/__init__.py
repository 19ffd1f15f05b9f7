"""Simulated devices that exchange the real bytes, and the bench and scenes that they look at."""

if __name__ == "simulators":  # imported from the folder beside emmc_rig, as before version 0.5
    raise ModuleNotFoundError(f"import emmc_rig.{__name__}, its name since 0.5", name=__name__)
