"""The form in which notebooks are committed; running this file brings those of the examples into it."""

from pathlib import Path

import nbformat

NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb"))
METADATA = {
    "accelerator": "GPU",  # of Colab
    "colab": {"gpuType": "T4"},
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def committed_form(path):
    """The text of a notebook without outputs and without what an editor adds, with sorted keys."""
    notebook = nbformat.read(path, nbformat.NO_CONVERT)
    notebook.metadata = METADATA
    for cell in notebook.cells:
        cell.metadata = {key: value for key, value in cell.metadata.items() if key == "tags"}
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    nbformat.validate(notebook)
    return nbformat.writes(notebook) + "\n"


if __name__ == "__main__":
    for notebook in NOTEBOOKS:
        notebook.write_text(committed_form(notebook), encoding="utf-8")
