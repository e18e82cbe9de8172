"""Shows a sensor live in a browser: surface, forces, camera image, plots and health.

>>> viewer = show(pipeline.sensor)
>>> viewer.update(pipeline.process(frame), frame)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cmp_tactile_viewer.notebook import NotebookViewer, show

__all__ = ["NotebookViewer", "show"]

# Imported with the first use of the name (PEP 562): viser takes half a second to import.
MODULES = {"NotebookViewer": "notebook", "show": "notebook"}


def __getattr__(name: str) -> Any:
    if name not in MODULES:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(import_module(f"{__name__}.{MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
