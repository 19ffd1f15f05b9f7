"""What every stage and camera must do, as pytest suites that other packages run against theirs.

`emmc-rig devices conform NAME` runs them against a device opened by name; `docs/plugins.md` tells
how a package runs them in its own tests. They need pytest (extra `test`).
"""
