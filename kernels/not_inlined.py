"""Functions that keep the code of a kernel small by staying out of line, where Warp has a way to say so."""

import inspect

import warp as wp

NOT_INLINED = {"inline": False} if "inline" in inspect.signature(wp.func).parameters else {}
"""Arguments of :func:`warp.func` for a function that is called and not inlined: ``@wp.func(**NOT_INLINED)``.

Warp 1.17 inlines all functions: its kernels compile for longer, with equal results. A decorator around
:func:`warp.func` would not do, because that finds the overloads of a function in the frame that calls it.
"""
