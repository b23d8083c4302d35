# JAX is optional. Where it is not installed, a type checker takes warp_bsc/jax.py for it, which imports it.
from typing import Any

def __getattr__(name: str) -> Any: ...
