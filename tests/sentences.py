"""Every sentence that a user can read, as a list to read aloud.

python -m tests.sentences [FOLDER...]          as pipeline/audit; default: the whole product
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

REPO = Path(__file__).parents[1]
PRODUCT = ("jobs", "pipeline", "schemas")


def sentences(*folders: str) -> Iterator[tuple[str, str]]:
    """Place and text of all strings that are not docstrings, with {} for fields, and of the pages."""
    for path in sorted(p for folder in folders or PRODUCT for p in (REPO / folder).rglob("*")):
        place = str(path.relative_to(REPO))
        if path.suffix == ".html":
            texts = re.split(r"<[^>]*>|\{[{%].*?[%}]\}|\n", path.read_text())
        else:
            texts = list(_strings(path)) if path.suffix == ".py" else []
        yield from ((place, s) for text in texts for s in re.split(r"[.:;|] |\n", text) if " " in s.strip())


def _strings(path: Path) -> Iterator[str]:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    docs = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "{}" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs | parts:
            yield node.value


if __name__ == "__main__":
    for where, sentence in dict.fromkeys(sentences(*sys.argv[1:])):
        print(f"{where}: {sentence.strip()}")
