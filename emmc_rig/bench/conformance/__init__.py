"""Conformance suites of stages and cameras, which other packages run against their own.

`emmc-rig devices conform NAME` runs them against a device opened by name; `docs/plugins.md` says
how a package runs them in its own tests. They need pytest (extra `test`).
"""
