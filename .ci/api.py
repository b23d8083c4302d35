"""Writes the API reference to build/api with pdoc: ``pip install -e ".[docs]" && python .ci/api.py``."""

import importlib
from pathlib import Path

import pdoc

MODULES = ["warp_bsc", "warp_bsc.kernels", "warp_bsc.checker"]

for module in map(importlib.import_module, MODULES):
    for name in module.__all__:
        value = getattr(module, name)  # pdoc looks only for names that are already there, and some are imported on use
        python = getattr(value, "func", getattr(value, "cls", value))  # what wp.func and wp.struct have wrapped
        setattr(module, name, python)
pdoc.render.configure(docformat="google")
pdoc.pdoc(*MODULES[:2], output_directory=Path("build/api"))  # the checker is a member of warp_bsc
