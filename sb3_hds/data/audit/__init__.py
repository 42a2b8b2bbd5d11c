"""Are these data fit for a verdict? Asked before any physics: one file for each kind of check."""

from sb3_hds.data.audit.audit import audit
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.results import Audit

__all__ = ["Audit", "Finding", "audit"]
