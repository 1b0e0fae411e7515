"""dualdepth: a replication of "Unsupervised High-Resolution Depth Learning From Videos With Dual Networks" (ICCV 2019).

```
import dualdepth
model = dualdepth.load()   # the package's own weights; or a file, a folder, owner/name on the model hub
depth = model.predict("street.jpg")           # (H, W) float32, relative depth
```
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"
__all__ = ["DepthModel", "InputError", "load"]

_HOMES = {"DepthModel": "dualdepth.model", "InputError": "dualdepth.errors", "load": "dualdepth.model"}


def __getattr__(name: str) -> Any:
    """Public names come from their modules when they are first asked for, since torch takes a second to import."""
    if name not in _HOMES:
        raise AttributeError(f"module 'dualdepth' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
