"""The notebooks run from top to bottom, and show what they say."""

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs(path):
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed: pip install '.[browser]'")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": FOLDER}}).execute()
    shown = [output.data for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs if "data" in output]
    players = [data for data in shown if "text/html" in data and data["text/html"].startswith("<iframe")]
    assert len(players) >= 1 and any("image/png" in data for data in shown)


def test_notebooks_are_kept_without_what_they_showed():
    paths = sorted(FOLDER.glob("*.ipynb"))
    assert len(paths) == 7
    for path in paths:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert not any(cell["outputs"] or cell["execution_count"] for cell in cells if cell["cell_type"] == "code")
