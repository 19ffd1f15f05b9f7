"""Device drivers: transport, codec and device of each protocol; they import no other package."""
