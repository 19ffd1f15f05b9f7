"""The documentation is run: every command block, as it stands, in order, in one fresh folder.

A comment before a block says why it is only parsed, not run: it needs hardware, or real files, or
takes minutes. EMMC_SIZE, which docs/commands.md names, makes the rest small.
"""

import csv
import itertools
import re
import runpy
import shlex
import tomllib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import typer
from matplotlib import pyplot
from PIL import Image
from placed import files_of, listed
from programs import done, program

import emmc_rig as emmc
from emmc_rig import cli
from emmc_rig.commands.options import SIZE_VARIABLE
from emmc_rig.live.steps import NEEDS
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.process import session_calibration as calibrate_session
from emmc_rig.session import measured_psi

ROOT = Path(__file__).parents[2]
REASONS = ("hardware", "real files", "minutes")
NOT_OURS = ("pip", "pytest")
"""Programs that brought the tests here, or are the tests."""
BLOCK = re.compile(
    r"^(?:<!-- (?P<why>[^\n]*) -->\n)?```(?P<language>[^\n]*)\n(?P<text>.*?)^```$", re.M | re.S
)
"""Of any language, so that the end of one is never taken for the beginning of the next."""


def blocks(document):
    """Yield (why it is not run, its commands) of every block that begins with a program."""
    for found in BLOCK.finditer(document.read_text(encoding="utf-8")):
        if not found["language"] and found["text"].split()[0] in ("emmc-rig", *NOT_OURS):
            yield found["why"], list(commands(found["text"]))


def written_files(document):
    """Yield name and text of every file that the page shows whole: its first line is the name."""
    for found in BLOCK.finditer(document.read_text(encoding="utf-8")):
        named = re.match(r"# ([\w-]+\.yaml)\n", found["text"])
        if found["language"] == "yaml" and named:
            yield named[1], found["text"]


def commands(text):
    """Yield the words of every emmc-rig command of a block, as a shell splits them."""
    for line in text.splitlines():
        for part in " ".join(shlex.split(line, comments=True)).split(" && "):
            words = part.split()
            assert words, line
            assert words[0] in ("emmc-rig", *NOT_OURS), f"not a command: {line}"
            if words[0] == "emmc-rig":
                yield words[1:]


ALL = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
DOCUMENTS = [document for document in ALL if any(found for _, found in blocks(document))]
TYPED = ("own-data", "figure")
"""Pages that end in a reconstruction to trust."""


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_of_the_documentation_is_one_of_the_program(document):
    whole = typer.main.get_command(cli.app)
    for why, found in blocks(document):
        assert why is None or why in REASONS, why
        for words in found:
            command, rest = whole, list(words)
            while (group := getattr(command, "commands", None)) is not None:
                command = group[rest.pop(0)]
            command.make_context(words[0], rest)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_no_line_that_is_a_command_is_passed_over(document):
    lines = re.findall(r"^(?:pip install .* && )?emmc-rig (?!\w+: ).*$", document.read_text(), re.M)
    found = [words for _, commands in blocks(document) for words in commands]
    assert len(found) == len(lines) > 0


def examples(page):
    """Return a page's Python, by the heading above."""
    return {
        re.findall(r"^## (.*)$", page[: found.start()], re.M)[-1]: found["text"]
        for found in BLOCK.finditer(page)
        if found["language"] == "python"
    }


PAGE = ROOT / "docs" / "which-cameras.md"
EXAMPLES = examples(PAGE.read_text())


@pytest.mark.parametrize("camera", EXAMPLES)
def test_every_camera_of_the_page_is_a_dozen_lines_that_run(camera, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = [line for line in EXAMPLES[camera].splitlines() if line and "import" not in line]
    assert len(lines) <= 12
    names: dict = {}
    exec(compile(EXAMPLES[camera], camera, "exec"), names)
    if camera == "One dense point spread function":
        assert "entries lie off their pixel" in capsys.readouterr().out
    elif camera == "Microlens array":
        assert np.abs(names["scene"].light_field - names["views"]).max() < 0.02
    else:
        result = names["result"]
        assert result.verdict.level != "do not use"
        frames = np.asarray(names["frames"])
        assert (names["psi"] @ result.light_field - frames).std() < 0.2 * frames.std()


NOTEBOOK = (ROOT / "docs" / "notebook.md").read_text()


def test_the_table_of_tasks_counts_their_lines_and_none_has_more_than_six():
    listed = re.findall(r"^\| \[(.*)\]\(#[\w-]+\) \| (\d) \|$", NOTEBOOK, re.M)
    counted = {
        task: len(list(filter(None, text.splitlines())))
        for task, text in examples(NOTEBOOK).items()
    }
    assert {task: int(lines) for task, lines in listed} == counted
    assert max(counted.values()) <= 6
    assert max(map(len, NOTEBOOK.splitlines())) <= 120


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of napari itself
def test_every_task_of_a_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng, white, places = np.random.default_rng(0), np.ones((5, 5, 48, 64, 3)), [(0, 0), (270, 162)]
    camera = emmc.camera("rgbw-bayer-1shot")

    def board(**shot):
        bench = emmc.camera({**camera.model_dump(), "shots": [shot]})
        return np.concatenate([bench.expose(white, rng).frames_dn for _ in range(2)])

    seen = [board(offset_um={"mask": place}) for place in (*places, (-200, 118))]
    names: dict = {
        "np": np,
        "emmc": emmc,
        "whiteboards": [board(masks=[]), *seen],
        "darks": np.concatenate([camera.expose(0 * white, rng).frames_dn for _ in range(4)]),
        "dn": camera.expose(emmc.scene("wide-disparity", size=(48, 64)), rng).frames_dn,
    }
    for task, text in examples(NOTEBOOK).items():
        if task in ("deepinv", "napari", "xarray"):
            if not find_spec(task):
                continue
            if task == "deepinv":
                import_module("peer_deepinv")  # the build of PyTorch may lack what it registers
            if task == "napari":  # without a window
                napari = import_module(task)
                monkeypatch.setattr(napari, "Viewer", napari.components.ViewerModel)
        exec(compile(text, task, "exec"), names)
    assert names["result"].verdict.level == names["measured"].verdict.level == "trust"
    better = names["result"].compare(names["scene"])
    assert better["psnr_db"] > better["replicate_psnr_db"]
    if "operator" in names:
        operator, truth = names["operator"], np.asarray(names["scene"])
        plain = operator.light_field(operator.A_dagger(names["y"]))[0]
        assert psnr_db(names["light_field"].numpy(), truth) > psnr_db(plain.numpy(), truth) + 6
    assert names["psi"].relative_difference(camera.psi((48, 64))) < 0.03
    np.testing.assert_array_equal(np.asarray(names["again"]), np.asarray(names["result"]))
    pyplot.close("all")


@pytest.mark.parametrize(
    ("word", "page"),
    [("Refocus", "notebook"), ("Depth", "notebook"), ("Windows", "tutorial"), ("figure", "figure")],
)
def test_a_heading_leads_the_search_for_a_word_to_its_page(word, page):
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    assert re.search(rf"^##? .*\b{word}\b", text, re.M)


def test_every_camera_and_bench_is_drawn_as_the_script_draws_it(tmp_path):
    pictures = ROOT / "docs" / "pictures"
    script = runpy.run_path(str(pictures / "draw_cameras.py"))
    assert len(script["PICTURES"]) == len(EXAMPLES)
    for name in script["PICTURES"]:
        assert f"pictures/camera-{name}.svg" in PAGE.read_text()
        assert (pictures / f"camera-{name}.svg").read_text() == script["drawn"](name)
    script = runpy.run_path(str(pictures / "draw_bench.py"))
    for name in script["PICTURES"]:
        assert f"pictures/bench-{name}.svg" in (ROOT / "docs" / "day-one.md").read_text()
        assert (pictures / f"bench-{name}.svg").read_text() == script["drawn"](name)


def test_every_concept_is_drawn_as_the_script_draws_it_and_shown():
    pictures = ROOT / "docs" / "pictures"
    script = runpy.run_path(str(pictures / "draw_concepts.py"))
    shown = set(
        re.findall(r"pictures/concepts-([\w-]+)\.svg", (ROOT / "docs/concepts.md").read_text())
    )
    assert shown == set(script["PICTURES"])
    for name in shown:
        assert (pictures / f"concepts-{name}.svg").read_text() == script["drawn"](name)


@pytest.mark.slow
def test_every_step_of_adaptive_has_its_picture():
    script = runpy.run_path(str(ROOT / "docs" / "pictures" / "draw_adaptive.py"))
    page = (ROOT / "docs" / "adaptive.md").read_text()
    for name, figure in script["figures"]((32, 40)).items():
        assert f"pictures/adaptive-{name}.webp" in page
        assert (ROOT / "docs" / "pictures" / f"adaptive-{name}.webp").is_file()
        assert all(axes.has_data() for axes in figure.axes)


def test_the_readmes_animation_turns_a_view_beside_the_frame():
    script = runpy.run_path(str(ROOT / "docs" / "pictures" / "draw_parallax.py"))
    light_field = np.random.default_rng(0).random((5, 5, 16, 20, 3)).astype(np.float32)
    pictures = script["animation"](light_field[0, 0, ..., 0], light_field, np.ones((16, 20)))
    left, right = (
        np.stack([np.asarray(picture)[:30, part] for picture in pictures])
        for part in (slice(0, 37), slice(54, None))
    )
    assert (left == left[0]).all()
    assert all((view != other).any() for view, other in itertools.pairwise(right))
    assert 1e5 < (ROOT / "docs" / "pictures" / "parallax.webp").stat().st_size < 1.5e6


@pytest.mark.parametrize("name", ["plot_8_turntable", "plot_9_power_meter"])
def test_the_worked_hooks_run_and_note_what_they_are_for(name):
    names = runpy.run_path(str(ROOT / "docs" / "examples" / f"{name}.py"))
    session = names["session"]
    notes = session.notes
    pyplot.close("all")
    if name == "plot_8_turntable":
        degrees = {frame.bench.shot: notes[frame.id]["degrees"] for frame in session.frames}
        assert degrees == {0: 0.0, 1: 0.0, 2: 30.0, 3: 30.0}
    else:
        power_w = [noted["power_w"] for noted in notes.values() if noted]
        assert len(power_w) == 12
        assert power_w == sorted(power_w, reverse=True)


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A fresh folder, a small size, and servers that end at once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(SIZE_VARIABLE, "32x40")
    monkeypatch.setattr("emmc_rig.live.server.Server.run", lambda *arguments, **more: None)


@pytest.fixture(scope="module")
def _fitted_once():
    """The simulated rig's whiteboards are the same in every page: they are fitted but once."""
    fit, known = measured_psi.session_outcome, {}

    def remembered(session, routes=None, *more):
        key = routes, *sorted((name, entry.sha256) for name, entry in session.stored.items())
        if key not in known:
            known[key] = fit(session, routes, *more)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (measured_psi, calibrate_session):
            patch.setattr(module, "session_outcome", remembered)
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("small", "_fitted_once")
@pytest.mark.parametrize(
    "document",
    [page for page in DOCUMENTS if page.stem not in ("tutorial", *TYPED)],
    ids=lambda path: path.name,
)
def test_every_block_of_the_documentation_runs_and_loses_nothing(document):
    for name, text in written_files(document):
        Path(name).write_text(text)
    for why, found in blocks(document):
        for words in found if why is None else ():
            before, ours = files_of(Path()), listed(Path())
            done(program(*words))
            after = files_of(Path())
            lost = [path for path in before if after.get(path) != before[path]]
            grown = [path for path in lost if path.name == "journal.jsonl"]
            assert all(ours.get(path) == before[path] or path in grown for path in lost), lost


FIGURE = re.compile(r"\d+(?:\.\d+)?")
TIMES = re.compile(r"\d+ min(?: \d+ s)?|[\d.]+ m?s\b|\d{4}-\d\d-\d\dT[\d:+]+")


def stable(text):
    """Return the lines of what a command prints without times, sorted, and their figures."""
    lines = sorted(TIMES.sub("?", " ".join(text.split("\n    "))).splitlines())
    figures = [float(figure) for line in lines for figure in FIGURE.findall(line)]
    return [FIGURE.sub("0", line) for line in lines], figures


@pytest.mark.slow
@pytest.mark.usefixtures("small", "_fitted_once")
def test_the_tutorial_as_typed_prints_and_shows_what_the_page_says_and_ends_in_trust(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv(SIZE_VARIABLE)
    page = (ROOT / "docs" / "tutorial.md").read_text()
    script = runpy.run_path(str(ROOT / "docs" / "pictures" / "draw_tutorial.py"))
    steps = script["STEP"].findall(page)
    typed = [shlex.join(words) for _, found in blocks(ROOT / "docs/tutorial.md") for words in found]
    assert [step[len("emmc-rig ") :] for step, _ in steps] == typed
    for step, shown in steps:
        code, out, err = program(*shlex.split(step)[1:])
        words, figures = stable(script["printed"](out + err, Path.cwd()))
        assert code == 0, err
        assert words == stable(shown)[0]
        np.testing.assert_allclose(figures, stable(shown)[1], rtol=0.1)
    assert re.search("^trust: ", shown, re.M)
    for name, figure in script["figures"](Path.cwd()).items():
        assert f"(pictures/tutorial-{name}.webp)" in page
        figure.savefig(f"{name}.webp", dpi=script["DOTS_PER_INCH"])
        now, stored = (
            np.asarray(Image.open(path / f"{prefix}{name}.webp").convert("L"), dtype=float) / 255
            for path, prefix in ((Path.cwd(), ""), (ROOT / "docs" / "pictures", "tutorial-"))
        )
        assert np.abs(now - stored).mean() < 0.02


def test_the_steps_of_day_one_are_those_of_the_live_page():
    page = " ".join((ROOT / "docs" / "day-one.md").read_text().split())
    assert f"Five steps: {', '.join(NEEDS)}." in page
    commands = getattr(typer.main.get_command(cli.app), "commands", {})
    assert f": {', '.join(NEEDS)}." in commands["live"].help


@pytest.mark.slow
@pytest.mark.usefixtures("small", "_fitted_once")
@pytest.mark.parametrize("name", TYPED)
def test_a_page_as_typed_ends_in_trust_and_shows_what_each_command_prints(name):
    page = ROOT / "docs" / f"{name}.md"
    typed = [words for why, found in blocks(page) if why is None for words in found]
    said = [(words[0], "".join(program(*words)[1:])) for words in typed]
    assert re.search(r"^trust: ", dict(said)["reconstruct"], re.M), said
    everything = without_numbers("".join(text for _, text in said))
    shown = [found["text"] for found in BLOCK.finditer(page.read_text("utf-8"))
             if found["language"] == "text"]  # fmt: skip
    assert all(without_numbers(text) in everything for text in shown), everything
    if name == "figure":
        names: dict = {}
        exec(compile(examples(page.read_text("utf-8"))["Draw it"], name, "exec"), names)
        assert names["verdict"].level == "trust"
        assert names["interval_db"][0] < names["accuracy_db"] < names["interval_db"][1]
        pyplot.close("all")


def without_numbers(text):
    """Return what a command prints, of another time, accuracy and folder."""
    for folder in (f"{Path.cwd()}/", "/home/me/"):
        text = text.replace(folder, "")
    return re.sub(r"\d+(\.\d+)?", "0", text)


def test_the_page_of_results_its_charts_and_the_readmes_table_are_what_the_command_makes():
    made = runpy.run_path(str(ROOT / "benchmarks" / "results_page.py"))["made"]()
    charts = {path for path in made if path.suffix == ".svg"}
    assert charts == set((ROOT / "docs" / "results" / "charts").iterdir())
    stale = [path.name for path, text in made.items() if path.read_text("utf-8") != text]
    assert not stale, "run `python benchmarks/results_page.py`"


def test_every_csv_of_results_says_when_and_by_which_command_it_was_measured():
    results = ROOT / "docs" / "results"
    with (results / "runs.csv").open(newline="", encoding="utf-8") as opened:
        runs = {row["file"]: row for row in csv.DictReader(opened)}
    assert set(runs) == {path.name for path in results.glob("*.csv")} - {"runs.csv"}
    assert all(row["date"] and row["version"] and row["command"] for row in runs.values())


def test_the_page_of_dependencies_names_each_package_with_its_licence():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = [
        *project["dependencies"],
        *itertools.chain(*project["optional-dependencies"].values()),
    ]
    page = (ROOT / "docs" / "dependencies.md").read_text("utf-8")
    rows = [line.strip("|").split(" | ") for line in page.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in row][-3:] for row in rows if row[-1].strip() != "used for"]
    assert all(licence and use for _, licence, use in rows)
    named = {name for names, *_ in rows for name in names.split(", ")}
    assert named == {re.split(r"[>=\[]", words)[0] for words in needed}
