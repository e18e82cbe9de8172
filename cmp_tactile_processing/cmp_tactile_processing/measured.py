"""What the stages measure and exchange: `Grid` (2-D), `Markers3D`, `Surface`, `ForceField`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum, IntFlag
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError

NAN = float("nan")
NS_PER_S = 10**9
# Standard deviation of normal noise per median of its absolute value.
MAD_TO_STD = 1.4826


class Status(IntEnum):
    """What a marker's coordinates rest on."""

    MISSING = 0
    MEASURED = 1
    PREDICTED = 2


# An array is compared with it many times faster than with the member itself.
MEASURED = int(Status.MEASURED)


def measured_share(status: NDArray[np.uint8]) -> float:
    """Share of the markers that are measured, 0 to 1."""
    return np.count_nonzero(status == MEASURED) / status.size


class GridFault(str, Enum):
    """Why corners are missing, by name; `Grid.reason` says it in words."""

    NONE = ""
    DARK = "dark"
    OVEREXPOSED = "overexposed"
    NO_CONTRAST = "no_contrast"
    NO_PATTERN = "no_pattern"
    OTHER_SIZE = "other_size"
    MIRRORED = "mirrored"
    TURNED = "turned"
    OTHER_COLOURS = "other_colours"
    TWO_PATTERNS = "two_patterns"
    OTHER_PATTERN = "other_pattern"
    AMBIGUOUS = "ambiguous"
    PARTLY_HIDDEN = "partly_hidden"


class NumberingKind(str, Enum):
    """What the numbers of a grid's corners hold for.

    ABSOLUTE: each names one corner of the print.  RELATIVE: they name the same corners from frame
    to frame since the first one, as far as motion between frames can be bounded.
    """

    ABSOLUTE = "absolute"
    RELATIVE = "relative"


@dataclass(frozen=True)
class GridShape:
    """Number of corners along y (rows) and x (cols), and of virtual markers per segment."""

    rows: int
    cols: int
    points_per_segment: int

    @property
    def corners(self) -> tuple[int, int]:
        """Shape of an array with one entry per corner."""
        return self.rows, self.cols

    @property
    def row_lines(self) -> tuple[int, int, int]:
        """Shape of an array with one entry per virtual marker along the rows."""
        return self.rows, self.cols - 1, self.points_per_segment

    @property
    def col_lines(self) -> tuple[int, int, int]:
        """Shape of an array with one entry per virtual marker along the columns."""
        return self.rows - 1, self.cols, self.points_per_segment


@dataclass(frozen=True)
class ViewPlacement:
    """Where a published view lies in the camera frame.

    The view is cut out at (x, y) and, when `flipped`, mirrored left to right: this is the one
    place where the handedness of a mirror's image is put right.
    """

    x: int
    y: int
    width: int
    height: int
    flipped: bool

    def to_frame(self, q_view: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the whole frame for pixels of the view, (..., 2) -> (..., 2)."""
        q_frame = np.array(q_view, dtype=np.float64)
        if self.flipped:
            q_frame[..., 0] = self.width - 1 - q_frame[..., 0]
        return q_frame + (self.x, self.y)

    def from_frame(self, q_frame: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the view for pixels of the whole frame, (..., 2) -> (..., 2)."""
        q_view = np.asarray(q_frame, dtype=np.float64) - (self.x, self.y)
        if self.flipped:
            q_view[..., 0] = self.width - 1 - q_view[..., 0]
        return q_view


@dataclass(frozen=True)
class Grid:
    """Gridlines of one view in one frame; missing points are NaN with status 0.

    corners (rows, cols, 2) px in the view image as published; corner_status (rows, cols).
    row_lines (rows, cols-1, n, 2) px, [i, j, k] from corner (i, j) towards (i, j+1);
    col_lines (rows-1, cols, n, 2) px, from corner (i, j) towards (i+1, j); their status.
    residual_px: RMS distance of the measured corners from the curves through their neighbours.
    fault, reason: why corners are missing, by name and in words; empty when none is.
    corner_std (rows, cols), row_line_std, col_line_std: standard deviation of each point, px, of a
    corner per coordinate, of a virtual marker across its gridline; NaN where it is not known.
    confidence: 0 to 1, how surely the corners bear their right numbers; a followed grid has that of
    the detection that it goes back to.
    followed: whether the corners were looked for where the last frame had them.
    numbering: what the numbers hold for.
    placement: the view's place in the frame, None for a grid that came without it.
    """

    shape: GridShape
    corners: NDArray[np.float64]
    corner_status: NDArray[np.uint8]
    row_lines: NDArray[np.float64]
    row_line_status: NDArray[np.uint8]
    col_lines: NDArray[np.float64]
    col_line_status: NDArray[np.uint8]
    residual_px: float = float("nan")
    reason: str = ""
    placement: ViewPlacement | None = None
    fault: GridFault = GridFault.NONE
    corner_std: NDArray[np.float64] | None = None
    row_line_std: NDArray[np.float64] | None = None
    col_line_std: NDArray[np.float64] | None = None
    confidence: float = float("nan")
    followed: bool = False
    numbering: NumberingKind = NumberingKind.ABSOLUTE

    @classmethod
    def missing(
        cls,
        shape: GridShape,
        reason: str,
        placement: ViewPlacement | None = None,
        fault: GridFault = GridFault.NO_PATTERN,
        numbering: NumberingKind = NumberingKind.ABSOLUTE,
    ) -> Grid:
        """A grid of which nothing was seen."""
        return cls(
            shape=shape,
            corners=np.full((*shape.corners, 2), np.nan),
            corner_status=np.zeros(shape.corners, np.uint8),
            row_lines=np.full((*shape.row_lines, 2), np.nan),
            row_line_status=np.zeros(shape.row_lines, np.uint8),
            col_lines=np.full((*shape.col_lines, 2), np.nan),
            col_line_status=np.zeros(shape.col_lines, np.uint8),
            reason=reason,
            placement=placement,
            fault=fault,
            corner_std=np.full(shape.corners, np.nan),
            row_line_std=np.full(shape.row_lines, np.nan),
            col_line_std=np.full(shape.col_lines, np.nan),
            confidence=0.0,
            numbering=numbering,
        )

    @property
    def found_fraction(self) -> float:
        """Share of the corners that were measured, 0 to 1."""
        return measured_share(self.corner_status)

    @property
    def corners_frame(self) -> NDArray[np.float64]:
        """`corners` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.corners)

    @property
    def row_lines_frame(self) -> NDArray[np.float64]:
        """`row_lines` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.row_lines)

    @property
    def col_lines_frame(self) -> NDArray[np.float64]:
        """`col_lines` in pixels of the whole camera frame."""
        return self._placement().to_frame(self.col_lines)

    def _placement(self) -> ViewPlacement:
        if self.placement is None:
            msg = "this grid does not know where its view lies in the frame"
            raise InputError(msg)
        return self.placement


class MarkerFault(IntEnum):
    """Why a marker has no position, or in a Surface no displacement."""

    NONE = 0
    NOT_SEEN = 1
    NOT_SEEN_LEFT = 2
    NOT_SEEN_RIGHT = 3
    NO_RAY = 4
    PARALLEL_RAYS = 5
    BEHIND_CAMERA = 6
    RAY_GAP = 7
    NO_REFERENCE = 8


@dataclass(frozen=True)
class Markers3D:
    """Markers in 3-D, gel frame, m; NaN where missing.

    position (rows, cols, 3), status and fault (rows, cols); covariance (rows, cols, 3, 3): of the
    position, m^2; ray_gap (rows, cols): length of the common normal, m, NaN for a monocular sensor.
    row_position (rows, cols-1, n, 3) and col_position (rows-1, cols, n, 3): virtual markers, each
    at its share of the material between its corners; row_status, col_status: measured where both
    views show where the gridline runs, predicted where that is interpolated between the corners;
    row_std, col_std: largest standard deviation across the gridline, m.
    pixels: the corners (rows, cols, 2) px that the markers were seen at, by view; None where they
    were not measured from images.
    """

    shape: GridShape
    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    fault: NDArray[np.uint8]
    covariance: NDArray[np.float64]
    ray_gap: NDArray[np.float64]
    row_position: NDArray[np.float64]
    row_status: NDArray[np.uint8]
    row_std: NDArray[np.float64]
    col_position: NDArray[np.float64]
    col_status: NDArray[np.uint8]
    col_std: NDArray[np.float64]
    pixels: Mapping[str, NDArray[np.float64]] | None = field(default=None, kw_only=True)


def no_virtual_markers(shape: GridShape) -> dict[str, Any]:
    """The fields of Markers3D for virtual markers where none is known."""
    return {
        "row_position": np.full((*shape.row_lines, 3), np.nan),
        "row_status": np.zeros(shape.row_lines, np.uint8),
        "row_std": np.full(shape.row_lines, np.nan),
        "col_position": np.full((*shape.col_lines, 3), np.nan),
        "col_status": np.zeros(shape.col_lines, np.uint8),
        "col_std": np.full(shape.col_lines, np.nan),
    }


class ReferenceFault(IntFlag):
    """What is wrong with the reference of a Surface; the bits of Surface.msg."""

    NONE = 0
    TOUCHED = 1  # something touched the gel when it was taken
    DESCRIPTION = 2  # it shows the gel other than described: displacements are off by some percent
    NOT_TAKEN = 4  # none was taken: displacements count from the description


@dataclass(frozen=True)
class Systematics:
    """Relative errors of displacements that are the same in all frames, second moments (11, 11).

    Components: the gain G (3, 3) row by row, measured displacement = (1 + G) true displacement; by
    how much the pattern is larger than described; by how much the gel is thicker.
    bias: of what the gel at rest shows; spread: of what it leaves open.
    """

    COMPONENTS: ClassVar[int] = 11

    bias: NDArray[np.float64]
    spread: NDArray[np.float64]

    @property
    def total(self) -> NDArray[np.float64]:
        """Both together."""
        return np.asarray(self.bias + self.spread)


@dataclass(frozen=True)
class Surface(Markers3D):
    """Markers in 3-D with their displacement; position = reference + displacement.

    What Markers3D has, but for status, fault and covariance, which are of the displacement.
    reference, displacement (rows, cols, 3): gel frame, m; NaN where missing.
    reference_id: 0 for the nominal surface of the sensor description, then counting up.
    reference_stamp_ns: stamp of the last frame averaged into the reference, ns; 0 if nominal.
    reference_faults: what is wrong with it.  systematics: errors beside those of `covariance`;
    None where no reference shows them.
    """

    reference: NDArray[np.float64]
    displacement: NDArray[np.float64]
    reference_id: int = 0
    reference_stamp_ns: int = 0
    reference_faults: ReferenceFault = ReferenceFault.NONE
    systematics: Systematics | None = None

    @classmethod
    def from_exact_points(
        cls,
        shape: GridShape,
        reference: NDArray[np.float64],
        corners: NDArray[np.float64],
        row_lines: NDArray[np.float64],
        col_lines: NDArray[np.float64],
    ) -> Surface:
        """A surface all points of which are known without error, gel frame, m."""
        return cls(
            shape=shape,
            reference=reference,
            position=corners,
            displacement=corners - reference,
            status=np.full(shape.corners, Status.MEASURED, np.uint8),
            fault=np.zeros(shape.corners, np.uint8),
            covariance=np.zeros((*shape.corners, 3, 3)),
            ray_gap=np.zeros(shape.corners),
            row_position=row_lines,
            row_status=np.full(shape.row_lines, Status.MEASURED, np.uint8),
            row_std=np.zeros(shape.row_lines),
            col_position=col_lines,
            col_status=np.full(shape.col_lines, Status.MEASURED, np.uint8),
            col_std=np.zeros(shape.col_lines),
        )

    @classmethod
    def from_positions(
        cls,
        shape: GridShape,
        reference: NDArray[np.float64],
        position: NDArray[np.float64],
        std: float = 0.0,
    ) -> Surface:
        """The surface of markers that something else has measured; no virtual markers.

        reference, position (rows, cols, 3) m, gel frame: at rest and now, NaN where not known; z is
        NaN where markers are known in the plane alone.  std: of each coordinate, m; 0 where it is
        not known.  Raises InputError for arrays of other shapes.
        """
        for name, points in (("reference", reference), ("position", position)):
            if points.shape != (*shape.corners, 3):
                msg = f"{name}: found shape {points.shape}, expected {(*shape.corners, 3)}"
                raise InputError(msg)
        displacement = position - reference
        known = np.isfinite(displacement[..., :2]).all(axis=-1)
        covariance = np.broadcast_to(std**2 * np.eye(3), (*shape.corners, 3, 3))
        return cls(
            shape=shape,
            reference=reference,
            position=position,
            displacement=displacement,
            status=np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8),
            fault=np.where(known, MarkerFault.NONE, MarkerFault.NOT_SEEN).astype(np.uint8),
            covariance=covariance.copy(),
            ray_gap=np.full(shape.corners, np.nan),
            **no_virtual_markers(shape),
            reference_id=0,
            reference_stamp_ns=0,
        )


def gridline_points(
    corners: NDArray[np.float64], between: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points along each gridline, (lines, (m - 1) (n + 1) + 1, d): every (n + 1)th is a corner.

    corners (lines, m, d).  between (lines, m - 1, n, d): virtual markers.
    """
    lines, _, dimension = corners.shape
    segments = np.concatenate([corners[:, :-1, None], between], axis=2)
    return np.concatenate([segments.reshape(lines, -1, dimension), corners[:, -1:]], axis=1)


@dataclass(frozen=True)
class SurfaceGrid:
    """A regular grid centred on the gel frame's z axis; point (i, j) is number i * cols + j.

    extent: distance between the outermost points along x and y, m.
    """

    rows: int
    cols: int
    extent: tuple[float, float]

    @property
    def x(self) -> NDArray[np.float64]:
        """The columns' x, (cols,) m."""
        return np.linspace(-self.extent[0] / 2, self.extent[0] / 2, self.cols)

    @property
    def y(self) -> NDArray[np.float64]:
        """The rows' y, (rows,) m."""
        return np.linspace(-self.extent[1] / 2, self.extent[1] / 2, self.rows)

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance between neighbours along x and y, m."""
        return self.extent[0] / (self.cols - 1), self.extent[1] / (self.rows - 1)

    @property
    def points(self) -> NDArray[np.float64]:
        """All points in order, (rows * cols, 2) m."""
        y, x = np.meshgrid(self.y, self.x, indexing="ij")
        return np.stack([x.ravel(), y.ravel()], axis=-1)


class SlipState(IntEnum):
    """State of the contact; the codes of ForceField.msg."""

    UNKNOWN = 0
    NO_CONTACT = 1
    STICK = 2
    INCIPIENT = 3
    FULL = 4


class ForceFlag(IntFlag):
    """What a user must know about a ForceField; the bits of ForceField.msg."""

    NONE = 0
    FEW_MARKERS = 1  # too few markers were seen: all is NaN
    AT_BORDER = 2  # a contact reaches the edge of the marker area and may extend beyond it
    BEYOND_MARKERS = 4  # the motion of the markers at the edge shows a force beyond them
    HIDDEN_CONTACT = 8  # markers under or beside a contact are missing
    NO_DEPTH = 16  # one view: the normal force is inferred, not measured
    LARGE_PRESS = 32  # the press is too deep for the linear model and is not corrected
    NOT_CONVERGED = 64  # the large-press correction has not settled
    POOR_FIT = (
        128  # no force explains how the markers moved: wrong description, reference or marker
    )
    IMPLAUSIBLE = 256  # the markers moved as no gel of this description can: all is NaN
    ZERO_DOUBTFUL = 512  # a force without contact, or the reference was taken under load
    DESCRIPTION_DOUBTFUL = 1024  # the gel at rest is not as described: the force is off by percents
    SCALE_UNCERTAIN = 2048  # modulus, thickness or optics are known too badly for newtons


@dataclass(frozen=True)
class SlipEstimate:
    """Whether a contact slides; NaN where it is not known.

    slip_ratio: share of the contact, weighted by normal force, that slides, 0 to 1: above 0 and
    below 1 slip is incipient.
    traction_ratio: tangential over normal force of the contact, the friction that it uses.
    friction_coefficient: of what slides, and its standard deviation friction_std; NaN where
    nothing slides, as a contact that sticks only shows that it is at least traction_ratio.
    """

    state: SlipState = SlipState.UNKNOWN
    slip_ratio: float = NAN
    traction_ratio: float = NAN
    friction_coefficient: float = NAN
    friction_std: float = NAN


@dataclass(frozen=True)
class Contact:
    """One of the separate contacts of a ForceField, gel frame.

    nodes (K,): numbers of the force nodes.  wrench (6,), covariance (6, 6), centre_of_pressure
    (3,), area: as in ForceField, of this contact alone.  outline (L, 3) m: closed polygon on the
    deformed contact surface, counter-clockwise as seen from outside, first point not repeated.
    at_border: it reaches the edge of the marker area and may go on beyond it.
    """

    nodes: NDArray[np.intp]
    wrench: NDArray[np.float64]
    covariance: NDArray[np.float64]
    area: float
    centre_of_pressure: NDArray[np.float64]
    outline: NDArray[np.float64]
    at_border: bool
    slip: SlipEstimate = SlipEstimate()


def _unknown_covariance() -> NDArray[np.float64]:
    return np.full((6, 6), NAN)


@dataclass(frozen=True)
class ForceField:
    """Force that the object exerts on the gel, gel frame; a press has negative z.

    rows, cols: shape of the node grid, M = rows * cols, node (i, j) at i * cols + j.
    position (M, 3) m: undeformed contact surface.  force (M, 3) N per node, 0 where there is no
    contact; force_std (M, 3) N: its standard deviations.  contact (M,) bool.
    wrench (6,): resultant force, N, and moment about reference_point, N m; forces act where their
    nodes have moved to, and so does centre_of_pressure (3,) m, NaN without contact.
    wrench_covariance (6, 6): of noise, resolution, and systematic_covariance (6, 6), what is the
    same in all frames: errors of the description, as far as they are known, and of the material.
    contact_area m^2, undeformed.  contacts: each separate contact, the strongest first.
    slip_state: that of `slip`, which sums up all contacts.
    valid_fraction: share of the markers that the force rests on, 0 to 1.
    noise_scale: noise of the displacements over what the parameters say of it.
    corrected: whether the large-press correction was applied.
    relaxed: whether the relaxation of the gel was taken out.
    All values are NaN (contact False) where too few markers were seen, and where they
    show what no gel of this description can.  Where contacts were not asked for, there are none,
    contact has all nodes that are pressed, and contact_area and wrench_covariance are NaN.
    """

    rows: int
    cols: int
    position: NDArray[np.float64]
    force: NDArray[np.float64]
    contact: NDArray[np.bool_]
    wrench: NDArray[np.float64]
    contact_area: float
    centre_of_pressure: NDArray[np.float64]
    reference_point: NDArray[np.float64]
    slip_state: SlipState
    valid_fraction: float
    regularization: float
    young: float
    poisson: float
    force_std: NDArray[np.float64] | None = None
    wrench_covariance: NDArray[np.float64] = field(default_factory=_unknown_covariance)
    contacts: tuple[Contact, ...] = ()
    slip: SlipEstimate = SlipEstimate()
    flags: ForceFlag = ForceFlag.NONE
    noise_scale: float = NAN
    corrected: bool = False
    relaxed: bool = False
    systematic_covariance: NDArray[np.float64] = field(default_factory=_unknown_covariance)

    def with_errors(self, factor: float = 1.0, relative: float = 0.0) -> ForceField:
        """With larger error bars: deviations times `factor`, and a share of each force more."""

        def covariance(of: ForceField | Contact, known: NDArray[np.float64]) -> Any:
            return factor**2 * known + relative**2 * np.outer(of.wrench, of.wrench)

        std = self.force_std
        if std is not None:
            std = np.hypot(factor * std, relative * np.abs(self.force))
        return replace(
            self,
            force_std=std,
            wrench_covariance=covariance(self, self.wrench_covariance),
            contacts=tuple(
                replace(item, covariance=covariance(item, item.covariance))
                for item in self.contacts
            ),
        )

    def with_systematic_errors(
        self, covariance: NDArray[np.float64], node_std: NDArray[np.float64]
    ) -> ForceField:
        """With systematic errors more: covariance (6, 6) of the wrench, node_std (M, 3) N."""
        contacts = tuple(
            replace(item, covariance=item.covariance + covariance) for item in self.contacts
        )
        return replace(
            self,
            force_std=None if self.force_std is None else np.hypot(self.force_std, node_std),
            wrench_covariance=self.wrench_covariance + covariance,
            systematic_covariance=self.systematic_covariance + covariance,
            contacts=contacts,
        )

    @property
    def systematic_std(self) -> NDArray[np.float64]:
        """Systematic part of `wrench_std`, (6,) N and N m."""
        return np.asarray(np.sqrt(np.diag(self.systematic_covariance)))

    @property
    def random_std(self) -> NDArray[np.float64]:
        """What differs from frame to frame of `wrench_std`, (6,) N and N m."""
        systematic = np.nan_to_num(self.systematic_covariance)
        return np.asarray(np.sqrt(np.diag(self.wrench_covariance - systematic)))

    @property
    def wrench_std(self) -> NDArray[np.float64]:
        """Standard deviations of the wrench, (6,) N and N m."""
        return np.asarray(np.sqrt(np.diag(self.wrench_covariance)))
