"""The camera model: light fields, masks, cameras, the imaging matrix and the sensor noise."""
