"""Device drivers: transport, codec and device of each protocol, with no other package of the project."""
