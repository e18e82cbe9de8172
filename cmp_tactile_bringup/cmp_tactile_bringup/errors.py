"""Errors that a user can cause and repair."""

from cmp_tactile_processing.errors import CmpTactileError


class ComponentError(CmpTactileError):
    """Something that the component container was asked for and cannot do."""


class ComponentLoadError(ComponentError):
    """A component that is not known, or whose constructor failed."""


class GraphError(CmpTactileError):
    """A graph file or an argument of it that cannot be used."""


class ArgumentError(GraphError):
    """A wrong argument on a command line, as a wrong option."""


class ClusterError(CmpTactileError):
    """A cluster that cannot be reached, or whose workers cannot do the work."""


class OutputError(CmpTactileError):
    """Results that cannot be written where they should go."""
