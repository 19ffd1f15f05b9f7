"""The formats that light fields are written in for others, by name; one module a family."""

from emmc_rig.formats import displays, geometry, hci, lytro, ome_zarr, pictures
from emmc_rig.formats.format import Format

FORMATS: dict[str, Format] = {
    form.name: form
    for module in (pictures, hci, lytro, ome_zarr, displays, geometry)
    for form in module.FORMATS
}
ALIASES = {"video": "mp4"}
"""Names of formats up to version 0.4, which --format still takes."""
