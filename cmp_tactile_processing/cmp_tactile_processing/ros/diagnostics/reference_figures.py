"""What is known of reference and drift, for the triangulator's diagnostics."""

from __future__ import annotations

from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper

__all__ = ["reference_figures"]


def reference_figures(keeper: ReferenceKeeper) -> dict[str, object]:
    """Figures by name; those of rest are of the last frames judged."""
    reference, judged, drift = keeper.reference, keeper.judged, keeper.drift
    figures: dict[str, object] = {
        "reference id": reference.id,
        "reference frames": reference.frames,
        "waiting for a reference": keeper.waiting,
    }
    if judged is not None:
        figures |= {
            "still": judged.still,
            "untouched": judged.untouched,
            "shake (um)": f"{judged.shake * 1e6:.2f}",
            "creep (um)": f"{judged.creep * 1e6:.2f}",
        }
        if judged.shape is not None:
            figures["off the shape at rest (um)"] = f"{judged.shape.bump * 1e6:.1f}"
    if drift is not None:
        figures |= {
            "drift (um)": f"{drift.largest * 1e6:.1f}",
            "drift shift (um)": f"{drift.shift * 1e6:.1f}",
            "drift turn (mrad)": f"{drift.turn * 1e3:.3f}",
            "drift shape (um)": f"{drift.shape * 1e6:.1f}",
        }
    return figures
