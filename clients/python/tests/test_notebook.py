"""The notebook of `examples`, which is made of a Python file and executed here. ``UPDATE_DOCS=1`` writes it anew."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import stride

EXAMPLES = Path(__file__).parents[1] / "examples"
NAME = "first_model"
MOST_BYTES = 400_000


def cells(nbformat: Any) -> list[Any]:
    """Cells of the Python file: ``# %%`` begins one of code, ``# %% [markdown]`` one of comments."""
    found: list[Any] = []
    for part in (EXAMPLES / f"{NAME}.py").read_text().split("# %%")[1:]:
        kind, _, text = part.partition("\n")
        if "markdown" in kind:
            text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in text.splitlines())
        new = nbformat.v4.new_markdown_cell if "markdown" in kind else nbformat.v4.new_code_cell
        found.append(new(text.strip(), id=f"cell-{len(found)}"))
    return found


def kinds(notebook: Any) -> list[tuple[str, list[str]]]:
    """Source of each cell, and the forms of its outputs: printed lines come in one output or in several."""

    def forms(cell: Any) -> list[str]:
        return sorted({" ".join(sorted(output.get("data", {"text": ""}))) for output in cell.get("outputs", [])})

    return [(cell.source, forms(cell)) for cell in notebook.cells]


def test_the_notebook_runs_and_is_as_it_was_run(
    server: stride.Server, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("STRIDE_SERVER", server.url)
    monkeypatch.setenv("STRIDE_TOKEN", (store / "token").read_text().strip())
    notebook = nbformat.v4.new_notebook(cells=cells(nbformat))
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=1800, resources=resources, record_timing=False).execute()
    # Only the version of Python is kept of what the machine says about itself.
    notebook.metadata["language_info"] = {"name": "python"}
    text = nbformat.writes(notebook) + "\n"
    assert len(text) < MOST_BYTES
    for secret in (os.environ["STRIDE_TOKEN"], str(tmp_path), server.url):
        assert secret not in text
    last = notebook.cells[-1].outputs[-1].data["text/html"]
    assert last.startswith("<iframe ") and "walks in a circle" in last
    path = EXAMPLES / f"{NAME}.ipynb"
    if os.environ.get("UPDATE_DOCS"):
        path.write_text(text)
    kept = nbformat.reads(path.read_text(), as_version=4)
    nbformat.validate(kept)
    assert kinds(kept) == kinds(notebook), "`UPDATE_DOCS=1 clients/python/check.sh` writes it anew"
