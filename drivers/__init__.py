"""Device drivers: transport, codec and device of each protocol; they import no other package."""

if __name__ == "drivers":  # imported from the folder beside emmc_rig, as before version 0.5
    raise ModuleNotFoundError(f"import emmc_rig.{__name__}, its name since 0.5", name=__name__)
