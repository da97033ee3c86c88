"""A zoo of small policies: what a policy is, how a zoo is stored, fetched, checked and built.

>>> import nnit_zoo
>>> zoo = nnit_zoo.load("PickCube-v1", download=True)
>>> zoo.batch("32-16-64-32", split="seen")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nnit_zoo.architecture import Architecture
    from nnit_zoo.errors import UserError
    from nnit_zoo.policy import PolicyBatch
    from nnit_zoo.zoo import TrainingView, Zoo, load

__all__ = ["Architecture", "PolicyBatch", "TrainingView", "UserError", "Zoo", "load"]
_MODULES = {"Architecture": "architecture", "PolicyBatch": "policy", "UserError": "errors"}

if not TYPE_CHECKING:  # mypy would take every name for one of this package

    def __getattr__(name: str) -> Any:
        """The class or function of this name; not imported at the top, so that `import nnit_zoo` is free of torch."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'zoo')}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
