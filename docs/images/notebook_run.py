"""Runs examples/notebook.ipynb, cell by cell as Jupyter does, and writes its outputs into it.

.venv/bin/python -m docs.images.notebook_run
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
from pathlib import Path
from typing import Any

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"


def outputs(notebook: dict[str, Any]) -> list[list[dict[str, Any]]]:
    """The outputs of its code cells, in order: what they print, and their last expression as Jupyter shows it."""
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [_outputs("".join(cell["source"]), k + 1, names) for k, cell in enumerate(cells)]


def _outputs(source: str, count: int, names: dict[str, Any]) -> list[dict[str, Any]]:
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, f"cell {count}", "exec"), names)
        shown = eval(compile(ast.Expression(last.value), f"cell {count}", "eval"), names) if last is not None else None
    found: list[dict[str, Any]] = []
    if printed.getvalue():
        found.append({"name": "stdout", "output_type": "stream", "text": printed.getvalue().splitlines(keepends=True)})
    if shown is not None:
        found.append({"data": _data(shown), "execution_count": count, "metadata": {}, "output_type": "execute_result"})
    return found


def _data(shown: Any) -> dict[str, Any]:
    """The one form in which the notebook shows a value."""
    html = shown._repr_html_() if hasattr(shown, "_repr_html_") else None  # None: a figure that is no page
    if html is not None:
        return {"text/html": [html]}
    if hasattr(shown, "_repr_png_"):
        return {"image/png": base64.b64encode(shown._repr_png_()).decode()}
    return {"text/plain": [repr(shown)]}


def main() -> None:
    """Write the outputs into the notebook."""
    notebook = json.loads(NOTEBOOK.read_text("utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for k, (cell, found) in enumerate(zip(cells, outputs(notebook), strict=True)):
        cell.update(execution_count=k + 1, outputs=found)
    NOTEBOOK.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
