"""Whether an AP function is worth learning from, before a training run is spent on it."""

from sb3_sap.check.check import check_permissibility
from sb3_sap.check.report import PermissibilityReport

__all__ = ["PermissibilityReport", "check_permissibility"]
