"""Force fields and contacts with what a test does not give left at rest."""

from dataclasses import replace
from typing import Any

import numpy as np

from cmp_tactile_processing.measured import Contact, ForceField, SlipState


def made_field(rows: int, cols: int, **fields: Any) -> ForceField:
    """A field of rows x cols nodes at the origin, which nothing touches."""
    count = rows * cols
    rest = ForceField(
        rows=rows,
        cols=cols,
        position=np.zeros((count, 3)),
        force=np.zeros((count, 3)),
        contact=np.zeros(count, np.bool_),
        wrench=np.zeros(6),
        contact_area=0.0,
        centre_of_pressure=np.full(3, np.nan),
        reference_point=np.zeros(3),
        slip_state=SlipState.NO_CONTACT,
        valid_fraction=1.0,
        regularization=1e-3,
        young=5e5,
        poisson=0.48,
    )
    return replace(rest, **fields)


def made_contact(nodes: list[int], **fields: Any) -> Contact:
    """A contact of a square millimetre at the origin."""
    some = Contact(
        nodes=np.array(nodes, np.intp),
        wrench=np.arange(6.0),
        covariance=np.eye(6),
        area=1e-6,
        centre_of_pressure=np.zeros(3),
        outline=np.zeros((3, 3)),
        at_border=False,
    )
    return replace(some, **fields)
