"""Prints all that the program says: the help of each command, and each text of the code by place.

Nothing is measured: the list is for reading. In an f-string a field reads {name}; `raise`, or the
name of the call that a text is given to, stands after its place.
"""

from __future__ import annotations

import ast
import io
import re
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path

ROOT = Path(__file__).parent.parent
PRODUCT = ("emmc_rig", "drivers", "calibration", "reconstruction", "simulators")
SENTENCE = re.compile(r"[A-Za-z]{2}.*\s.*[A-Za-z]", re.DOTALL)
"""Letters on both sides of a space: anything shorter is a key, a unit or a format."""
OF_PAGES = re.compile(r">[^<>]+<|\"[^\"\n]+\"|`[^`]+`|(?:title|placeholder|aria-label)=\"[^\"]+\"")


def text_of(node: ast.AST) -> str:
    """Return a string, with the fields of an f-string as {name}; "" for anything else."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(map(text_of, node.values))
    return f"{{{ast.unparse(node.value)}}}" if isinstance(node, ast.FormattedValue) else ""


def texts(
    node: ast.AST, documents: bool = False, said_by: str = ""
) -> Iterator[tuple[int, str, str]]:
    """Yield line, what says it, and text of each string below a node, an f-string as a whole.

    documents: with strings that stand alone, which document the code.
    """
    if isinstance(node, ast.Raise):
        said_by = "raise"
    elif isinstance(node, ast.Call) and said_by != "raise":
        said_by = ast.unparse(node.func).rpartition(".")[2]
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Expr) and text_of(child.value) and not documents:
            continue
        if isinstance(child, ast.Constant | ast.JoinedStr) and not isinstance(node, ast.JoinedStr):
            yield child.lineno, said_by, text_of(child)
        yield from texts(child, documents, said_by)


def said(path: Path) -> Iterator[tuple[int, str, str]]:
    """Yield line, what says it, and each text of two words or more that a file says to users."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        found = texts(ast.parse(source))
    else:
        matches = OF_PAGES.finditer(source)
        found = ((source.count("\n", 0, m.start()) + 1, path.suffix[1:], m[0]) for m in matches)
    for line, said_by, text in found:
        if SENTENCE.search(text):
            yield line, said_by, " ".join(text.split())


def helps() -> Iterator[tuple[str, str]]:
    """Yield the words of each command and sub-command, and their help."""
    import typer

    from emmc_rig import cli

    waiting = [("emmc-rig", typer.main.get_command(cli.app))]
    for words, command in waiting:
        printed = io.StringIO()  # typer returns plain help, and prints rich help
        with redirect_stdout(printed):
            returned = command.get_help(typer.Context(command, info_name=words))
        yield words, printed.getvalue() or returned
        members = getattr(command, "commands", {})
        waiting += [(f"{words} {name}", member) for name, member in members.items()]


def main() -> None:
    """Print both; with paths as arguments only the texts of those files."""
    chosen = [Path(name) for name in sys.argv[1:]]
    if not chosen:
        for words, text in helps():
            print(f"=== {words} --help\n{text}")
        chosen = [p for name in PRODUCT for p in sorted((ROOT / name).rglob("*"))]
    for path in chosen:
        if path.suffix in (".py", ".html", ".js"):
            for line, said_by, text in said(path.resolve()):
                print(f"{path.resolve().relative_to(ROOT)}:{line} [{said_by}] {text}")


if __name__ == "__main__":
    main()
