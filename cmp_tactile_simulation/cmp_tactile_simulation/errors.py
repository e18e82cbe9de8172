"""Errors that the simulator raises on purpose; anything else is a bug."""

from cmp_tactile_processing.errors import CmpTactileError


class SimulationError(CmpTactileError):
    """Base of the simulator's errors."""


class SceneError(SimulationError):
    """A scene file that cannot be used: names file, key, found and expected."""


class IndenterError(SimulationError):
    """An indenter that cannot be used: a wrong size, a mesh that is not watertight or too fine."""


class ContactError(SimulationError):
    """A contact that cannot be solved: it starts inside the gel, or leaves the contact patch."""


class LoadError(ContactError):
    """A load that the contact cannot carry."""


class CommandError(SimulationError):
    """A target or load that a live sensor does not take: names field, found and expected."""


class MaterialError(SimulationError):
    """A deformation outside what the material model can follow."""


class OutputError(SimulationError):
    """A recording that cannot be written."""
