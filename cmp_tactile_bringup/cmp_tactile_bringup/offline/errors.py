"""Errors of offline processing that a user can cause and mend."""

from cmp_tactile_processing.errors import CmpTactileError

__all__ = ["ClusterError", "OutputError", "TaskError"]


class ClusterError(CmpTactileError):
    """A cluster that cannot be reached, or whose workers cannot do the work."""


class OutputError(CmpTactileError):
    """Results that cannot be written where they should go."""


class TaskError(CmpTactileError):
    """A recording that could not be processed; the text is what another process found."""
