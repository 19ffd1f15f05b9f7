"""Every page has one head: the verdict, then what to do next."""

import numpy as np
import pytest

from emmc_rig.commands.output import show_verdict
from emmc_rig.formats.format import Export
from emmc_rig.reconstruction.verdict.rules import CONSISTENT, LEVELS
from emmc_rig.report.page import light_field_head, typed
from emmc_rig.report.viewer import render_viewer


def head_of(page):
    """Return the words of the first thing in the page's main part."""
    main = page[page.index("<main>") :].removeprefix("<main>").lstrip()
    assert main.startswith("<aside class="), main[:80]
    assert 'aria-label="Verdict"' in main[:80]
    return main[: main.index("</aside>")]


def test_a_viewer_of_a_scene_has_the_head_too(light_field):
    head = head_of(render_viewer(Export("a", "", light_field, source="my views")))
    assert "No verdict" in head
    assert "<code>emmc-rig figure &#39;my views&#39;</code>" in head


def test_a_result_in_memory_is_offered_no_command_without_a_path():
    head = light_field_head({"verdict": {"level": "trust", "reasons": []}})
    assert head.next
    assert not any("emmc-rig" in line for line in head.next)


@pytest.mark.parametrize(("found_db", "tone"), [(20.0, "watch"), (22.0, "good")])
def test_a_trusted_result_below_the_baseline_is_not_shown_as_good(found_db, tone):
    verdict = {"level": "trust", "reasons": []}
    head = light_field_head({"verdict": verdict, "psnr_db": found_db, "replicate_psnr_db": 21.5})
    assert head.tone == tone
    below = "1.5 dB worse than the baseline (centre view in all places)" in head.why
    assert below == (tone == "watch") == ("trust" not in head.level)
    assert CONSISTENT in head.why


def test_every_level_of_a_verdict_is_a_sentence_of_a_head():
    for level in LEVELS:
        head = light_field_head({"verdict": {"level": level, "reasons": []}})
        assert level in head.level.lower()
        assert (head.tone == "good") == (level == "trust")


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({}, ""),
        ({"stated_db": None, "stated_interval_db": None}, ""),
        ({"stated_db": 31.24}, "; estimated accuracy 31.2 dB"),
        (
            {"stated_db": 31.24, "stated_interval_db": [29.81, 33.02]},
            "; estimated accuracy 31.2 dB (29.8 to 33.0 in 9 of 10 captures)",
        ),
        (
            {"stated_db": 31.24, "stated_worst_db": 24.13, "stated_worst_at": [40, 66]},
            "; estimated accuracy 31.2 dB; least accurate about row 40, column 66: 24 dB",
        ),
        (
            {"stated_db": 31.24, "stated_worst_db": 29.0, "stated_worst_at": [40, 66]},
            "; estimated accuracy 31.2 dB",
        ),
    ],
    ids=["none by an earlier version", "no method's", "no interval", "interval", "worst", "even"],
)
def test_the_head_says_the_stated_psnr_with_its_interval(stated, words):
    head = light_field_head({"verdict": {"level": "trust", "reasons": []}, **stated})
    assert head.why == f"{CONSISTENT}{words}"


def test_a_path_is_typed_short_below_this_folder_and_quoted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert typed(tmp_path / "one/two") == "one/two"
    assert typed("my own") == "'my own'"
    assert typed(tmp_path.parent) == str(tmp_path.parent)


@pytest.fixture(scope="module")
def light_field():
    return np.random.default_rng(0).random((3, 3, 24, 32, 3), dtype=np.float32)


def test_the_terminal_says_with_care_where_the_page_does(capsys):
    metrics = {"verdict": {"level": "trust", "reasons": []}, "stated_db": 25.3}
    show_verdict(metrics)
    assert capsys.readouterr().out == f"trust: {CONSISTENT}\nestimated accuracy: 25.3 dB\n"
    show_verdict({**metrics, "psnr_db": 20.0, "replicate_psnr_db": 21.5})
    worse = "against the truth it is 1.5 dB worse than the baseline (centre view in all places)"
    assert capsys.readouterr().out.startswith(f"trust with care: {CONSISTENT}, but {worse}\n")
