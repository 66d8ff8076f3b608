"""Which use of a label is worth it on a user's own problem: base, penalty, shaping, E, or Algorithm 1."""

from sb3_sap.comparison.compare import compare
from sb3_sap.comparison.decision import Comparison

__all__ = ["Comparison", "compare"]
