# PyTorch is optional. Where it is not installed, a type checker takes warp_bsc/torch.py for it, which imports it.
from typing import Any

def __getattr__(name: str) -> Any: ...
