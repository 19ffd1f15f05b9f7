"""Formats of light fields: `format` defines the class, `registry` lists all."""
