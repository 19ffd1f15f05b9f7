"""Words that users did not understand stay out of everything that the program says."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import words

SAYS = (*words.PRODUCT, "docs", "README.md")
MADE = ("docs/_build", "docs/gallery", "docs/command-line.md")
"""Folders and files in SAYS that a script makes: not searched."""
REPLACED = {
    r"copied (true )?(centre|middle)": "baseline: centre view in all places",
    r"readings missed": "residual 5 sigma",
    r"evidence is flat": "depth cannot be determined",
    r"relief: one plane": "scene treated as flat",
    r"\bstates [\w ]*\d|\bdB (are )?stated|stated PSNR|PSNR stated": "estimated accuracy 20.2 dB",
    r"lies at the noise": "calibration good: residual 0.76 x noise variance (limit 1.5)",
    r"\bmetered: |\bshots? 0 by": "shot 1 exposure 0.255 s",
    r"change\(s\) by hand": "2 changes by hand, of a real rig alone",
    r"come on top": "time excludes exposures",
    r"\bplan (lamp_checks|response|colours|turned)\b|\bit costs\b": "add `lamp_checks: 6`",
    r"\broutes?\b": "calibration method",
    r"\bheld[- ]out\b": "validation",
    r"turn the wheel": "scroll",
    r"\bsway\b": "animate",
    r"model of each place": "local model",
    r"\bmisfits?\b": "unexplained residual",
    r"\bleft[ _]out\b": "excluded",
    r"\bscreening\b": "frame clean-up",
    r"drawn towards": "TV + dictionary",
    r"\bp patches\b": "about 3 s for 64x80 pixels",
    r"\bPsi to \d|\bPsi to \{": "calibration error 0.41 %",
    r"stands_um": "fixed positions",
    r"\bkinds? of camera\b": "driver",
    r"--leave-out|leave_out": "--skip",
    r"--route\b": "--method",
    r"\bpresent (one|frame|place)\b": "current",
    r"\bover plain\b": "defined, or not shown",
}
"""By pattern, what is said instead."""
SAID = {
    ".md": r".+",
    ".html": r">[^<>]+<|\"[^\"\n]+\"",
    ".js": r"\"[^\"\n]+\"|`[^`]+`",
    ".css": r"\"[^\"\n]+\"",
}
"""By the end of a file's name, what of it is read by users; of Python code strings are."""
TEMPLATE = re.compile(r"\{[{%#].*?[}%#]\}", re.DOTALL)
FIELD = re.compile(r"\{[^{}]*\}")
"""Of an f-string: its name is the code's."""
ANY = re.compile("|".join(REPLACED), re.IGNORECASE)
KEY = re.compile(r"-{0,2}[a-z][a-z0-9_.-]*")
"""A name that files and scripts know, which stays: not a text."""


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield what a file says to users, with its line; docstrings only of commands: their help."""
    if path.suffix == ".py":
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for line, _, text in words.texts(tree, documents=path.parent.name == "commands"):
            yield line, FIELD.sub("{}", text)
    elif path.suffix in SAID:
        text = path.read_text(encoding="utf-8")
        text = TEMPLATE.sub(lambda code: "\n" * code[0].count("\n"), text)
        for found in re.finditer(SAID[path.suffix], text):
            yield text.count("\n", 0, found.start()) + 1, " ".join(found[0].strip('<>`"').split())


def returned(path: Path) -> list[str]:
    """Return the replaced words that a file says, each with its place and what to say instead."""
    return [
        f"{path}:{line}: {found[0]!r}, say: {instead}"
        for line, text in texts(path)
        if ANY.search(text) and not KEY.fullmatch(text)
        for pattern, instead in REPLACED.items()
        if (found := re.search(pattern, text, re.IGNORECASE))
    ]


def files(name: str) -> list[Path]:
    """Return the files of a folder, or the file."""
    place = words.ROOT / name
    return (
        [path for path in sorted(place.rglob("*")) if path.is_file()] if place.is_dir() else [place]
    )


@pytest.mark.parametrize("name", SAYS)
def test_no_word_that_was_replaced_is_said_again(name):
    skipped = [words.ROOT / place for place in MADE]
    found = [
        line
        for path in files(name)
        if not any(path.is_relative_to(folder) for folder in skipped)
        for line in returned(path)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.py", 'raise AppError(f"{n} shots were left out")'),
        ("b.html", "<p>{{ n }} readings missed</p>"),
        ("c.js", 'say("Sway");'),
        ("d.md", "Two shots were left out."),
    ],
)
def test_a_word_that_comes_back_is_found(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    assert returned(tmp_path / name)


def test_the_list_for_reading_has_helps_and_texts_of_python_and_of_pages(capsys, monkeypatch):
    files = ("emmc_rig/captures/run.py", "emmc_rig/commands/devices.py", "emmc_rig/live/page.html")
    monkeypatch.setattr("sys.argv", ["words.py", *(str(words.ROOT / name) for name in files)])
    words.main()
    out = capsys.readouterr().out
    assert "[raise] {request.out}: holds something other than a session; name another" in out
    assert "[tell] no serial port: plug a stage in, or try --rig simulated" in out
    assert 'aria-label="what is shown"' in out
    assert "test_" not in out
    helps = dict(words.helps())
    assert "Home the axes of a stage" in helps["emmc-rig devices home"]


def test_keys_of_files_and_what_is_said_of_the_code_are_not_taken_for_words(tmp_path):
    path = tmp_path / "a.py"
    path.write_text('"""Judged by whiteboards held out."""\nvalue = metrics["held_out"]\n')
    assert returned(path) == []
