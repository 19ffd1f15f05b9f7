import base64
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pages import Page

from emmc_rig.formats.cameras import find_camera
from emmc_rig.report.display import HEAT, DisplayCurve, heat, round_up
from emmc_rig.report.page import Head
from emmc_rig.report.report import ReportContent, render, write_report

VIEWS, HEIGHT, WIDTH = 5, 48, 64


@pytest.fixture
def content() -> ReportContent:
    rng = np.random.default_rng(3)
    smooth = cv2.GaussianBlur(rng.random((HEIGHT, WIDTH, 3)), (0, 0), 4)
    truth = np.empty((VIEWS, VIEWS, HEIGHT, WIDTH, 3), np.float32)
    for v, u in np.ndindex(VIEWS, VIEWS):
        truth[v, u] = np.roll(smooth, (v - 2, u - 2), axis=(0, 1))
    psi = rng.random((VIEWS, VIEWS, HEIGHT, WIDTH)).astype(np.float32) / 25
    return ReportContent(
        title="First light",
        described=find_camera("rgbw-bayer-1shot"),
        estimate=truth + np.float32(0.1),
        truth=truth,
        frames=rng.random((3, HEIGHT, WIDTH)).astype(np.float32),
        whiteboards=[("View v 0, u 0", psi[0, 0]), ("Dark", np.zeros((HEIGHT, WIDTH)))],
        metrics={
            "psnr_db": 20.0,
            "ssim": 0.9312,
            "replicate_psnr_db": 17.5,
            "psi_relative_error": 0.0213,
            "exact_psi_psnr_db": 20.4,
            "calibration_cost_db": 0.4,
            "method": "tv",
            "status": "converged",
            "advice": "",
            "scene": "near-planar",
            "camera": "bayer-rgbw",
            "seed": 7,
            "warnings": ["Diffraction: Fresnel number 1.8"],
            "command": "emmc-rig demo --seed 7",
            "versions": {"numpy": "2.0.0"},
        },
        stage_s={"whiteboards": 1.5, "reconstruction": 2.5},
    )


def page_data(page: str) -> dict:
    found = re.search(r'type="application/json" id="viewer-data">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def picture(uri: str) -> np.ndarray:
    encoded = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    decoded = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    return decoded[..., ::-1] if decoded.ndim == 3 else decoded


def test_the_report_is_one_file_that_refers_to_nothing_outside_itself(content, tmp_path):
    write_report(tmp_path / "report.html", content)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    page = (tmp_path / "report.html").read_text("utf-8")
    assert not re.search(r"https?://|url\(|@import|fetch\(|XMLHttpRequest|WebSocket", page)
    assert Page(page).foreign == []
    assert "default-src 'none'" in page
    assert not re.search(r"\{\{\w+\}\}", page)


def test_names_from_outside_are_shown_not_run(content):
    attack, mono = "<script>alert('x')</script>&\"'</script>", find_camera("rgbw-mono")
    hostile = replace(
        content,
        title=attack,
        described=mono.model_copy(update={"title": attack, "reference": attack}),
        whiteboards=[(attack, content.whiteboards[0][1])],
        stage_s={attack: 1.0},
        metrics={
            **content.metrics,
            attack: attack,
            "status": attack,
            "versions": {attack: attack},
            "scene": attack,
            "camera": attack,
            "command": attack,
            "warnings": [attack],
            "assumed": attack,
            "source": attack,
        },
    )
    page = render(hostile)
    assert "<script>alert" not in page
    # The viewer's data and its script.
    assert page.count("<script") == render(content).count("<script") == 2
    assert page.count("</script") == 2


def test_text_that_looks_like_a_placeholder_stays_text(content):
    assert "<h1>{{data}}</h1>" in render(replace(content, title="{{data}}"))


def test_without_a_truth_there_is_no_comparison(content):
    page = render(
        replace(content, truth=None, metrics={"status": "converged", "psnr_db": float("nan")})
    )
    assert page_data(page)["truth"] is None
    assert "Where it is wrong" not in page
    assert "Over the baseline" not in page


@pytest.mark.parametrize(
    ("value", "shown"),
    [(float("nan"), "not a number"), (float("inf"), "infinite"), (None, "not measured")],
)
def test_a_figure_that_is_not_finite_is_said_in_words(content, value, shown):
    names = ("psnr_db", "ssim", "replicate_psnr_db", "psi_relative_error", "calibration_cost_db")
    page = render(replace(content, metrics={**content.metrics, **dict.fromkeys(names, value)}))
    assert page.count(f'<td class="figure">{shown}</td>') == len(names)
    assert not re.search(r">\s*-?(nan|inf)\b", page)


EVIDENCE = {"explained": 0.9, "noise": 0.02, "parallax": 0.1}
TRUSTED = {"level": "trust", "reasons": [], "features": EVIDENCE}
FLAT = {
    "level": "cannot tell",
    "reasons": [{"level": "cannot tell", "what": "no parallax", "remedy": "focus nearer"}],
    "features": {**EVIDENCE, "parallax": 0.001},
}


def cards_of(page: str) -> dict[str, tuple[str, str]]:
    """Return value and tone of every tile, by its label."""
    found = re.findall(r'<div class="card (.*?)">\s*<h3>(.*?)</h3><p class="value">(.*?)</p>', page)
    return {
        label: (value, tone.split()[-1] if tone.split() else "") for tone, label, value in found
    }


def test_three_figures_come_first_with_their_units_and_what_is_good(content):
    page = render(replace(content, metrics={**content.metrics, "verdict": TRUSTED}))
    assert cards_of(page) == {
        "Accuracy (PSNR)": ("20.0 dB", ""),
        "Over the baseline": ("+2.5 dB", "good"),
        "Explained": ("90%", "good"),
    }
    notes = re.findall(r'<p class="note">(.*?)</p>', page)
    assert "10.0% of white" in notes[0]  # -20 dB
    assert "17.5 dB; good: above 0" in notes[1]


def test_without_a_truth_the_figures_are_the_methods_own(content):
    metrics = {"stated_db": 31.2, "stated_interval_db": [29.0, 33.0], "verdict": TRUSTED}
    page = render(replace(content, truth=None, metrics=metrics))
    assert list(cards_of(page)) == ["Estimated accuracy", "Explained", "Noise"]


@pytest.mark.parametrize(
    "more",
    [{"replicate_psnr_db": 21.0, "verdict": TRUSTED}, {"verdict": FLAT}],
    ids=["below", "flat"],
)
def test_nothing_is_green_beside_a_result_that_is_flat_or_below_the_baseline(content, more):
    page = render(replace(content, metrics={**content.metrics, **more}))
    tones = [tone for _, tone in cards_of(page).values()]
    assert tones
    assert "good" not in tones
    assert 'class="verdict good"' not in page


def test_all_but_verdict_figures_and_picture_is_folded_with_the_method_last(content):
    metrics = {**content.metrics, "parameters": {"misfit": 0.597, "at_end": 0.0}}
    page = render(replace(content, metrics=metrics))
    main = page[page.index("<main>") : page.index("</main>")]
    folded = re.findall(r'<details class="folded"><summary><h2>(.*?)</h2> <span>(.*?)</span>', main)
    assert all(about for _, about in folded)
    assert [title for title, _ in folded][-1] == "Inside the method"
    assert main.count("<section") == 1  # the viewer
    shown = re.sub(r'<details class="folded">.*', "", main, flags=re.S)
    assert "<table" not in shown
    assert "misfit" not in shown
    row = main[main.index("Unexplained residual") :]
    assert "0.60 x noise" in row[:200]


def test_the_verdict_comes_first_with_its_remedy_alone(content):
    reasons = [{"level": "doubt", "what": "shots differ", "remedy": "capture shot 2 again"}]
    verdict = {"level": "doubt", "reasons": reasons}
    page = render(replace(content, metrics={**content.metrics, "verdict": verdict}, source="r"))
    places = [
        page.index(words)
        for words in ('aria-label="Verdict"', "shots differ", "capture shot 2 again", "20.0 dB")
    ]
    assert places == sorted(places)
    assert "emmc-rig figure" not in page[: page.index("</aside>")]


@pytest.mark.parametrize("metrics", [{"verdict": {"level": "trust", "reasons": []}}, {}])
def test_a_result_with_nothing_against_it_says_what_to_use_it_for(content, metrics):
    page = render(replace(content, metrics=metrics, source="my results/one"))
    head = page[page.index("What to do next") : page.index("</aside>")]
    assert "<code>emmc-rig export &#39;my results/one&#39;</code>" in head
    assert "<code>emmc-rig figure &#39;my results/one&#39;</code>" in head


def test_the_head_of_a_page_must_say_what_to_do_next():
    with pytest.raises(ValueError, match="what to do next"):
        Head("trust", "all agree", [])


def test_commands_in_the_head_are_code_and_its_words_are_escaped(content):
    reasons = [{"level": "doubt", "what": "<b>", "remedy": "run `a <b> c`, see <i>"}]
    page = render(replace(content, metrics={"verdict": {"level": "doubt", "reasons": reasons}}))
    assert "run <code>a &lt;b&gt; c</code>, see &lt;i&gt;" in page


def test_the_stages_are_bars_as_long_as_their_seconds(content):
    page = render(replace(content, stage_s={"one": 1.0, "two": 4.0}))
    bars = re.findall(r'<th scope="row">(\w+)</th><td><i style="width: ([\d.]+)%"></i></td>', page)
    assert bars == [("one", "25.0"), ("two", "100.0")]
    assert "1.00 s (20%)" in page


def test_the_heat_bar_has_the_colours_of_the_pictures(content):
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*colour) for colour in HEAT)
    assert f".bar .heat {{ background: linear-gradient(90deg, {stops}); }}" in render(content)


def test_values_that_are_not_finite_in_the_estimate_are_counted(content):
    estimate = content.estimate.copy()
    estimate[0, 0, :2, :3, 0] = np.nan
    page = render(replace(content, estimate=estimate))
    assert "6 values that are not finite" in page


def test_every_tile_of_the_sprite_is_its_view(content):
    data = page_data(render(content))
    assert data["views"] == {"rows": 5, "columns": 5, "height": HEIGHT, "width": WIDTH}
    curve = DisplayCurve.fitted_to(content.truth)
    sprite = picture(data["truth"]).astype(int)
    assert sprite.shape == (5 * HEIGHT, 5 * WIDTH, 3)  # both sides are whole JPEG blocks
    for v, u in np.ndindex(5, 5):
        tile = sprite[v * HEIGHT : (v + 1) * HEIGHT, u * WIDTH : (u + 1) * WIDTH]
        assert np.abs(tile - curve.encode(content.truth[v, u]).astype(int)).mean() < 2


def test_views_are_padded_to_whole_jpeg_blocks(content):
    narrow = content.truth[:, :, :45, :50]
    data = page_data(render(replace(content, truth=narrow, estimate=narrow)))
    assert picture(data["truth"]).shape == (5 * 48, 5 * 64, 3)


def pictures(page: str, alt: str) -> list[np.ndarray]:
    return [picture(uri) for uri in re.findall(rf'src="([^"]+)" alt="{alt}"', page)]


def test_frames_are_shown_on_one_scale_to_within_a_screen_level(content):
    curve = DisplayCurve.fitted_to(content.frames)
    shown = pictures(render(content), r"Shot \d")
    for codes, frame in zip(shown, content.frames, strict=True):
        np.testing.assert_array_equal(codes, curve.encode(frame))


def test_a_uniform_error_gives_a_flat_map(content):
    page = render(content)
    (error,) = pictures(page, "Error map")
    (scale,) = map(float, re.findall(r"<span>([\d.]+) and more</span>", page))
    np.testing.assert_allclose(
        error,
        np.broadcast_to(heat(np.array(255 * 0.1 / scale + 0.5, np.uint8)), error.shape)[..., ::-1],
        atol=4,
    )


@pytest.mark.parametrize(
    ("value", "end"), [(0.004, 0.005), (0.1, 0.1), (0.101, 0.15), (0.6, 0.7), (0.0, 1.0), (8, 10)]
)
def test_scales_end_at_readable_values(value, end):
    assert round_up(value) == end


def test_a_bare_monochrome_run_can_be_shown(content):
    page = render(
        ReportContent(
            title="t", estimate=content.estimate[..., :1], frames=content.frames[:1], metrics={}
        )
    )
    assert picture(page_data(page)["estimate"]).shape[-1] == 3
    assert "None" not in re.sub(r"<script.*", "", page, flags=re.S)


def test_a_dark_scene_is_lifted_and_its_highlights_stay_below_white():
    dark = np.geomspace(0.001, 0.2, 5000).astype(np.float32)
    curve = DisplayCurve.fitted_to(dark)
    levels = curve.encode(dark)
    assert levels.max() == 255
    assert (levels == 255).mean() < 0.02
    assert np.median(levels) > 64
