"""Errors of the component container that a user can cause and mend."""

from cmp_tactile_processing.errors import CmpTactileError

__all__ = ["ComponentError", "ComponentLoadError", "GraphError", "UnknownComponentError"]


class ComponentError(CmpTactileError):
    """Something that the component container was asked for and cannot do."""


class ComponentLoadError(ComponentError):
    """A component that is not known, or whose constructor failed."""


class UnknownComponentError(ComponentError):
    """An id that no loaded component has."""


class GraphError(CmpTactileError):
    """A graph file or an argument of it that cannot be used."""
