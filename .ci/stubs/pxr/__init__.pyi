# USD as the type checker sees it: untyped, because its modules fill themselves from C++ when they are imported.
from typing import Any

def __getattr__(name: str) -> Any: ...
