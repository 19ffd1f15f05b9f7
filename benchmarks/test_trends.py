"""What the table of trends says of figures that are known."""

import pandas as pd
import pytest
from trends import fall_db, falls


def rows(method, figures):
    """Figures by shots and noise, of one scene."""
    return [
        {"scene": "one", "method": method, "shots": shots, "noise": noise, "psnr_db": psnr_db}
        for (shots, noise), psnr_db in figures.items()
    ]


def test_the_fall_is_from_any_worse_capture_to_any_better_one():
    assert fall_db([30, 29, 31, 30.5, 28]) == 3
    assert fall_db([30, 31, 32]) == 0


def test_falls_by_noise_and_by_shots_are_told_apart_and_rivals_counted_where_both_are():
    adaptive = {(1, 0.004): 30.0, (1, 0.001): 29.8, (3, 0.004): 29.5, (3, 0.001): 33.0}
    rival = {(1, 0.004): 28.0, (3, 0.004): 30.1, (3, 0.001): 32.0}
    table = falls(pd.DataFrame(rows("adaptive", adaptive) + rows("tv-dict", rival)))
    found = table.set_index("method")
    assert found.less_noise_db["adaptive"] == pytest.approx(0.2)
    assert found.more_shots_db["adaptive"] == pytest.approx(0.5)
    assert found.behind_db["adaptive"] == pytest.approx(0.6)
    assert found.less_noise_db["tv-dict"] == 0
    assert pd.isna(found.behind_db["tv-dict"])
