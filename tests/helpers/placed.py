"""Files of a folder, and the files listed as results."""

import hashlib

from emmc_rig.store.folders import FILES, Listing


def files_of(folder):
    """Return the bytes' digest of every file, and where every link leads, by name."""
    return {
        path: str(path.readlink())
        if path.is_symlink()
        else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


def listed(folder):
    """Return every file that a result says it wrote, with its digest."""
    found = {}
    for path in folder.rglob(FILES):
        found[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        listing = Listing.read(path.parent)
        assert listing is not None
        found |= {path.parent / name: sha256 for name, sha256 in listing.files.items()}
    return found
