"""Errors of the viewer that a user can cause and repair."""

from cmp_tactile_processing.errors import CmpTactileError


class ViewerError(CmpTactileError):
    """A page that cannot be served, or a source that cannot be shown."""
