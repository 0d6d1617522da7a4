"""Constraints along a path: sets of them, those of a user's own, bounds on their violation, paths on their manifold.

Records of them are in :mod:`apex_ompl.scene`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet as ConstraintSet
    from apex_ompl.constraints.proof import ConstraintCertificate as ConstraintCertificate
    from apex_ompl.constraints.proof import prove_motion as prove_motion
    from apex_ompl.constraints.proof import prove_path as prove_path
    from apex_ompl.constraints.user import UserConstraint as UserConstraint

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "constraint_set": "ConstraintSet",
        "proof": "ConstraintCertificate prove_motion prove_path",
        "user": "UserConstraint",
    },
)
