"""Training of dictionaries: resumed as undisturbed, refused where a file is in the way, drawn."""

import numpy as np
import pytest
import train_dictionary
from learning import LearningSettings
from train_dictionary import draw_atoms, train
from training_patches import PatchSettings

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.reconstruction.dictionary import Dictionary

PATCHING = PatchSettings(rows=4, columns=4, count=120)
LEARNING = LearningSettings(atoms=24, sparsity=3, iterations=3)


@pytest.fixture
def scenes(tmp_path):
    """Files of two light fields."""
    rng = np.random.default_rng(0)
    for name in ("cat", "dog"):
        save_hdf5(tmp_path / f"{name}.h5", rng.random((2, 2, 20, 24, 3), dtype=np.float32), {})
    return [str(tmp_path / f"{name}.h5") for name in ("cat", "dog")]


def test_a_stopped_training_goes_on_to_the_undisturbed_atoms(scenes, tmp_path, monkeypatch):
    whole = train(tmp_path / "whole.h5", scenes, PATCHING, LEARNING)
    assert Dictionary.load(tmp_path / "whole.h5").size == 24
    assert '"cat"' in whole.provenance

    def stop(*_):
        raise KeyboardInterrupt

    # The first step is kept, and then the training stops.
    monkeypatch.setattr(train_dictionary, "CHECKPOINT_INTERVAL_S", -1.0)
    with monkeypatch.context() as patch:
        save = train_dictionary.save_checkpoint
        patch.setattr(train_dictionary, "save_checkpoint", lambda *given: (save(*given), stop()))
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts.h5", scenes, PATCHING, LEARNING)
    assert (tmp_path / "parts.checkpoint.npz").exists()
    with pytest.raises(AppError, match="other patches or settings"):
        train(tmp_path / "parts.h5", scenes[:1], PATCHING, LEARNING)
    parts = train(tmp_path / "parts.h5", scenes, PATCHING, LEARNING)
    np.testing.assert_array_equal(parts.atoms, whole.atoms)
    assert not (tmp_path / "parts.checkpoint.npz").exists()


def test_a_file_in_the_way_is_refused_before_the_training(scenes, tmp_path):
    (tmp_path / "d.png").write_bytes(b"mine")
    with pytest.raises(AppError, match="exists already"):
        train(tmp_path / "d.h5", scenes, PATCHING, LEARNING)
    with pytest.raises(AppError, match=r"ends in \.h5"):
        train(tmp_path / "d.txt", scenes, PATCHING, LEARNING)


def test_the_picture_shows_centre_view_and_epi_of_every_atom():
    atoms = np.zeros((2, 3, 3, 4, 5, 3), np.float32)
    atoms[0] = 1
    for u in range(3):
        atoms[1, 1, u, 2, 1 + u, 0] = 1  # a red dot that moves one pixel per view
    picture = draw_atoms(Dictionary.normalised(atoms, "ksvd"))[1::3, 1::3, ::-1]
    grey, red, white = [128, 128, 128], [255, 128, 128], [255, 255, 255]
    tile_high = 4 + 1 + 3
    assert (picture[:4, :5] == white).all()
    dot = np.argwhere((picture == red).all(axis=-1)) - np.argwhere(
        (picture == white).all(axis=-1)
    ).min(axis=0)
    right = dot[:, 1].min() // 6 * 6 if dot[:, 1].min() > 5 else 0
    down = 0 if right else tile_high + 1
    places = {(int(y) - down, int(x) - right) for y, x in dot}
    assert len(places) == 4
    assert (picture == grey).all(axis=-1).any()
    rows = sorted(y for y, _ in places)
    assert rows == [2, 5, 6, 7]
    slope = [x for y, x in sorted(places) if y >= 5]
    assert np.diff(slope).tolist() == [1, 1]
