"""Formats of light fields: `format` says what one is, `registry` knows all."""
