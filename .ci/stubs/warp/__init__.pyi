# Warp as the type checker sees it: untyped, because the bodies of kernels are Warp's language, not Python.
from typing import Any

def __getattr__(name: str) -> Any: ...
