"""Globs of `emmc-rig import` in place of a table."""

import numpy as np

from emmc_rig.captures.import_table import rows_of_globs


def test_a_glob_names_an_array_of_each_of_its_files(tmp_path):
    for name in ("scene10", "scene2"):
        np.savez(tmp_path / f"{name}.npz", meas=np.ones((2, 3)), mask=np.ones((2, 3)))
    listed = rows_of_globs({"shot": [f"{tmp_path}/scene*.npz@meas"]})
    assert [(row.path.name, row.array) for row in listed] == [
        ("scene2.npz", "meas"), ("scene10.npz", "meas"),
    ]  # fmt: skip


def test_a_file_with_an_at_in_its_name_is_that_file(tmp_path):
    np.save(tmp_path / "shot@noon.npy", np.ones((2, 3)))
    (row,) = rows_of_globs({"shot": [f"{tmp_path}/shot@*.npy"]})
    assert (row.path.name, row.array) == ("shot@noon.npy", "")
