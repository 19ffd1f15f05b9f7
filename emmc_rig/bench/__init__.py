"""The devices of a bench, real or simulated, and how they are named in a configuration."""
